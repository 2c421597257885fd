"""The simulated camera: the gate course as the vehicle sees it."""
