"""A recorded flight through the flight's own code once more, on stepped time."""
