"""Lockstep: the bridge and its simulator in one thread on one stepped clock, over MAVLink bytes.

The loops and the link are those of a real flight; time, network and camera are replaced. No wall
clock is read, so a flight depends only on its arguments.
"""
