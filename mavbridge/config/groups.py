"""Headings of the help, in their order."""

from cyclopts import Group

VEHICLE = Group("Vehicle", sort_key=1)
ENGAGING = Group("Engaging and releasing", sort_key=1.5)
POLICY = Group("Policy", sort_key=2)
CAMERA = Group("Camera", sort_key=3)
OUTPUT = Group("Output", sort_key=4)
RATES = Group("Rates", sort_key=5)
LIMITS = Group("Limits: older inputs end the flight", sort_key=6)
ENVELOPE = Group("Envelope: leaving it ends the flight", sort_key=7)
SETPOINTS = Group("Setpoints: the most that is asked of the vehicle", sort_key=8)
RARE = Group("Rarely needed", sort_key=9)
