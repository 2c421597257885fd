"""``mavbridge demonstrate``: flights of simulated gate courses, flown or labelled by an expert."""
