"""Observers of a flight (timing, terminal, Rerun), none of which can delay it."""
