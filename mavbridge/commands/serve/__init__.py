"""``mavbridge serve``: a policy on this computer for flights and robots elsewhere."""
