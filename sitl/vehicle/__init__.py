"""Simulated quadrotor: physics, air, sensors, attitudes, and the base of both firmwares."""
