"""``mavbridge evaluate``: performance of a policy on courses that it was not trained on."""
