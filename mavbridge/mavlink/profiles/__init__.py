"""Firmware profiles, the only firmware-specific code."""
