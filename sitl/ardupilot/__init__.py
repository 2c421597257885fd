"""ArduCopter as a peer sees it: modes, radio, parameters, failsafes and MAVLink."""
