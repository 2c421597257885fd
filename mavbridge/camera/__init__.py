"""Video sources behind the `Camera` port; `mavbridge.camera.open` selects one by its name.

Every source returns its newest frame, counts unread frames, stamps each frame with its exposure (or
else its arrival), and raises CameraError when it has failed for good.
"""
