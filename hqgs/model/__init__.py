"""The Gaussians, their rasterization and its gradients, and where they start."""
