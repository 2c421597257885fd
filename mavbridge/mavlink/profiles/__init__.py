"""One profile a firmware: nothing else in the tree asks which one it is."""
