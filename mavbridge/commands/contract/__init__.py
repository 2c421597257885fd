"""``mavbridge contract``: a first draft of a contract file."""
