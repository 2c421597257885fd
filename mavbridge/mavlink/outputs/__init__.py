"""Messages that carry a policy's actions to the vehicle, and their echo check."""
