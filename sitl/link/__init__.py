"""MAVLink link of the simulated vehicle: sockets, framing and shared messages."""
