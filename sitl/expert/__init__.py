"""A demonstrator that flies gate courses from the true pose."""
