"""The simulated quadrotor without its firmware: physics, air, sensors."""
