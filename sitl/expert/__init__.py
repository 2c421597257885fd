"""Demonstrators that fly gate courses from the true pose."""
