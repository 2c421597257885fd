"""Bring-up policies that fly a fixed program by velocity feedback: no weights, no torch."""
