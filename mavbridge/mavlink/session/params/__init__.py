"""One vehicle's parameters: read, checked before a flight, set for it and put back after it."""
