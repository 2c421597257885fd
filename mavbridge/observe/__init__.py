"""Observers of a flight (timing, terminal, Rerun). None of them can delay it."""
