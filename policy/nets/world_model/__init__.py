"""Latent world model: predicts the camera's images and the vehicle's motion."""
