"""Policies that were written or trained elsewhere."""
