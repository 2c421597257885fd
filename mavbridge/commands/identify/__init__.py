"""``mavbridge identify``: what a vehicle does with the actions that it is sent.

recording  what was sent and how the vehicle moved, by a sink of the flight
fit        least-squares step response: gain, dead time, lag
axes       which number of an action moves what, in which unit
results    the measured beside what the policy was trained with, as table, words and JSON
run        the command: a usual flight of the scripted doublet, then all of that
"""
