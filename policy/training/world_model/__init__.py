"""Training of a world model: autoencoder first, then dynamics."""
