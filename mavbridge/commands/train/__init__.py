"""``mavbridge train``: flight folders in, a checkpoint out."""
