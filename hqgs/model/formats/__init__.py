"""Files of Gaussians (PLY, SPZ, .splat, glTF): each format reads and writes arrays by the names of `Gaussians`."""
