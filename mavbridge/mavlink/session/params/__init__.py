"""Parameters of one vehicle: read, checked before a flight, set for it and restored after it."""
