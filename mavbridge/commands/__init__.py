"""Commands beside the flight itself."""
