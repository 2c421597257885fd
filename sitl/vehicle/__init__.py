"""Simulated quadrotor without its firmware: physics, air, sensors."""
