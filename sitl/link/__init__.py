"""The simulated vehicle's side of MAVLink."""
