"""``mavbridge demonstrate``: flights to learn from, by an expert who sees the truth."""
