"""What the bridge knows of each firmware: nothing else in the tree asks which one it is."""
