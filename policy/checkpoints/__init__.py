"""Weights on disk, with their contract in the header."""
