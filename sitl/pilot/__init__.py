"""Pilots of the simulated vehicle: a person at its transmitter, and the expert."""
