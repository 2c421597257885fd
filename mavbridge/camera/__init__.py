"""Video sources behind the `Camera` port; `mavbridge.camera.open` picks one by its name.

Every source gives its newest frame, counts those that nobody read, stamps each with the time of
exposure (or failing that, of arrival), and says so when it has died.
"""
