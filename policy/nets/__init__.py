"""Network architectures: image encoders, condition encoders, the diffusion head."""
