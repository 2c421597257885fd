"""Pilot of the simulated vehicle, who moves its receiver: a person or the expert."""
