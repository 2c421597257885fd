"""PX4 as a peer sees it: modes, stick input, parameters, failsafes and MAVLink."""
