"""``mavbridge export``: flights as a LeRobot dataset of format v3.0.

flights --policy.data--> Episode --rows--> Stretch --dataset--> data/*.parquet, meta/*
                                                  `--video--> videos/*.mp4
"""
