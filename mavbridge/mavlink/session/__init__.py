"""The conversation with one vehicle, without I/O: handshake, parameters, streams, echo."""
