"""Video sources behind the `Camera` port; `mavbridge.camera.open` picks one by its name.

Every source returns its newest frame, counts the frames that were not read, stamps each with its
exposure (or else its arrival), and raises CameraError when it has failed for good.
"""
