"""``mavbridge evaluate``: how well a policy flies courses that it was never trained on."""
