"""``mavbridge check``: whether a flight could begin, without flying."""
