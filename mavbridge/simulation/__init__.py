"""The bridge and its simulator in one thread on one stepped clock, over real MAVLink bytes.

The loops, the link and everything that they call are those of a real flight; replaced are time,
the network and the camera. No wall clock is read, so a flight depends on its arguments alone.
Users know this as lockstep.
"""
