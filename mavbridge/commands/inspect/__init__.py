"""Report of a recorded flight, on the terminal and in the viewer."""
