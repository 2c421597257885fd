"""The messages that carry a policy's actions to the vehicle, one module each, and their echo."""
