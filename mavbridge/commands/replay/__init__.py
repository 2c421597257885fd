"""``mavbridge replay``: a recorded flight through the flight's own code once more."""
