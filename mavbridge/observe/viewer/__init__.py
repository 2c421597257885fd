"""Rerun viewer for live, recorded and imagined flights."""
