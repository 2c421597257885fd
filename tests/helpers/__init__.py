"""Shared test code: builders of values, fakes, and flights in real processes."""
