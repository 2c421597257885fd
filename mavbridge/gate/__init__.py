"""Who holds the sticks, and how they move: the last step before the link."""
