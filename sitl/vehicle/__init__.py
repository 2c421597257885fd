"""The simulated quadrotor: physics, flight controller, parameters, radio."""
