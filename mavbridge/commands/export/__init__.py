"""``mavbridge export``: flights as a LeRobot dataset of format v3.0.

flights --policy.data--> FlightData --run--> Stretch --dataset--> meta/*, data/*, videos/*
"""
