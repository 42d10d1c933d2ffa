"""Structure from motion: cameras and points from photos alone, by COLMAP."""
