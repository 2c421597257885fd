"""Motion of the vehicle without a network: rotations, stick loop, prediction, fixed programs."""
