"""Bytes of MAVLink to values and back, without I/O."""
