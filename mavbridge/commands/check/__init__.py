"""``mavbridge check``: checks whether a flight can begin, without flying."""
