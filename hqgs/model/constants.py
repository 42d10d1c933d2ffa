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

# First points along edges, and photos that agree on their depth; chosen on held-back photos.
FLAT = 0.2  # share of the points that all pixels alike get
# Nearest points of a view that tell a range of depths; what widens it; and how many points a view needs.
AROUND, WIDENED, LEAST_AROUND = 6, 1.6, 3
STRAY = 0.01  # share of the nearest and of the farthest points of a view that do not bound its depths
AGREE_LONGEST, AGREE_SMOOTH = 800, 1.0  # px: of a smaller copy; of noise there is less then
ASKED, AGREEING, AGREED = 4, 2, 0.6  # photos that are asked, that must agree, and the correlation of patches
APART = 0.01  # of the median distance between cameras: photos nearer than that are from one place
# Points that are found back: px of the small copies, within which; photos that are asked in the second look;
# the correlation that one alone must have; and what widens a range between known depths.
FOUND_BACK, ASKED_AGAIN, ALONE, AROUND_KNOWN = 1.0, 8, 0.8, 1.15

# Depths all over a photo, where neighbours tell what others leave open (semi_global.py): up to so many
# photos. They gained 0.5 to 1.2 dB in rooms of 8 and 12 photos, 0.05 in four captures; of 17 to 25 nothing.
SMOOTH_PHOTOS = 12
SMOOTH_LONGEST, SMOOTH_PATCH, LAYERS = 240, 7, 48  # px of a small photo, of a patch; depths that are tried
# Variances, where 1 is white squared: the least, by which a flat patch is like none; what tells nothing.
FLAT_PATCH, SMOOTH_FLAT = 1e-5, 1e-4
# Costs of a step of one layer, and of more; how much a step from black to white divides that by, beyond 1.
SLOPE, JUMP, ACROSS_EDGES = 0.3, 2.0, 20.0
# Correlations: of what is not in another photo; where none confirms a depth. px of small photos within which
# one does, and how much farther a surface lies that is seen through a point.
UNLIKE, SMOOTH_AGREED, CONFIRMED, SEEN_THROUGH = 0.3, 0.7, 1.5, 1.05

# What there is to see of a scene: the share within the radius of `content`; how far from the middle, in such
# radii, a camera sees it fill the picture, and how high above it; Gaussians that tell the size.
CONTENT_SHARE, CONTENT_DISTANCE, CONTENT_RAISED, CONTENT_SAMPLED = 0.8, 2.2, 0.35, 4096
