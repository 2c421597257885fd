"""Session with one vehicle, without I/O: discovery, parameters, streams, condition."""
