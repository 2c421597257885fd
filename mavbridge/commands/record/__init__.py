"""``mavbridge record``: flights of a human pilot as training data; only requests are sent.

guard process, read-only --ticks--> PilotView --+   packets ----+
camera --> vision loop, which encodes nothing --+--> Episodes --+--> Recorder, one each
keys, radio switch, arming --> EpisodeControl --wanted, mark--> Episodes (folders, marks)
"""
