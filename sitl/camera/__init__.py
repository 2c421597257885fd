"""Simulated camera: the gate course seen from the vehicle."""
