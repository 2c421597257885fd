"""``mavbridge export``: flights as a LeRobot dataset of format v3.0.

flights --policy.data--> Episode --rows--> Stretch --dataset--> meta/*
                                                       '--files--> data/*.parquet, videos/*.mp4
"""
