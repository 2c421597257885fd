"""The last step before the link: who holds the sticks, and how fast they move."""
