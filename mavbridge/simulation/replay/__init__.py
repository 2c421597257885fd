"""Replay of a recorded flight through the flight's code, on a stepped clock."""
