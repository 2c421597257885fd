"""Conversion between MAVLink bytes and values, without I/O."""
