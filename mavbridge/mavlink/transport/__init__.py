"""Transports for MAVLink bytes (UDP, TCP, serial) and the connection over them."""
