"""Scene files: PLY, SPZ, fewer bands of the harmonics."""
