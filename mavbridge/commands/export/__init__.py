"""``mavbridge export``: flights as a LeRobot dataset of format v3.0, or as MCAP files.

flights --policy.data--> FlightData --run--> Stretch --dataset--> meta/*, data/*, videos/*
flight --recording--> RecordedFlight --mcap_file--> NAME.mcap
"""
