"""What a scenario can do to a flight, one step after the other."""
