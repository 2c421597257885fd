"""A latent world model: what the camera will see and how the vehicle will move."""
