"""Recorded flights as training data."""
