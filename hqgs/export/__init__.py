"""Smaller scene files: fewer Gaussians, fewer bands of the harmonics, fewer bits."""
