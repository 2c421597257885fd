"""ArduCopter as a peer sees it: modes, radio, parameters, failsafes, and its side of MAVLink."""
