"""Gate courses, ground truth about them, and the referee of a flight."""
