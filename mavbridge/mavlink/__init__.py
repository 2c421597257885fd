"""MAVLink; all code that knows the protocol."""
