"""The bridge and its simulator in one thread on one stepped clock, over real MAVLink bytes.

The loops, the link and everything that they call are those of a real flight; what is replaced is
what a flight has around it: time, the network and the camera. Nothing here reads a wall clock, so
an episode depends on its arguments alone. The only part of mavbridge that may import ``sitl``.
"""
