"""Files of Gaussians, PLY and SPZ: each format reads and writes arrays by the names of `Gaussians`."""
