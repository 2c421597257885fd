"""``mavbridge record``: flights of a human pilot as training data; only requests are sent.

guard process, read-only --ticks, packets--> PilotView --+
camera --> vision loop, which encodes nothing ----------+--> EpisodeSink --> Recorder, one each
keys, radio switch, arming --> EpisodeControl --wanted, mark--> Episodes (folders, marks)
"""
