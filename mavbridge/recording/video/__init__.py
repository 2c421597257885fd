"""Video files and the process that encodes them."""
