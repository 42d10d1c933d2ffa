"""Numbers that all of the model goes by."""

import math

SH_C0 = math.sqrt(1 / math.pi) / 2  # the constant basis function
MAX_SH_DEGREE = 3
LEAST_SCALE = 1e-30  # that files are read with: a scale of 0 has no log

# The first Gaussians.
INITIAL_OPACITY = 0.1  # Kerbl et al. 2023
MIN_SQUARE_DISTANCE = 1e-7  # points that coincide get this one, so that log(scale) stays finite
NEAREST, NEAREST_OF_DISCS = 3, 5  # neighbours whose distances give a point's scale; that tell directions
THINNEST = (1.0, 0.2, 0.1)  # of a disc's three axes, of the longest: few neighbours tell no more

# What there is to see of a scene: the share within the radius of `content`; how far from the middle, in such
# radii, a camera sees it fill the picture, and how high above it; Gaussians that tell the size.
CONTENT_SHARE, CONTENT_DISTANCE, CONTENT_RAISED, CONTENT_SAMPLED = 0.8, 2.2, 0.35, 4096
