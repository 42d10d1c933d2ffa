"""Files of Gaussians: PLY, SPZ, .splat, glTF. Each reads and writes arrays by the names of `Gaussians`."""
