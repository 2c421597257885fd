"""``mavbridge replay``: computes a recorded flight again with the flight's own code."""
