"""The scene that needs no download: a ray-cast room, which holds no Gaussian."""
