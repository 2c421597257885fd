"""Training of policies and world models from recorded flights."""
