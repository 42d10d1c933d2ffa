"""The numbers of scenes that several files use, each with its meaning and unit.

Limits keep damaged files and short memory out; what decides between good inputs was tried on the captures of
the tests and on fern, fox and horns; those of GPS were set by hand.
"""

# Every scene.
TEST_EVERY = 8  # views: each 8th by name is held out (Mildenhall et al. 2019), where nothing else is said
FEWEST_PHOTOS = 5  # with fewer none is compared with the others
ENOUGH_SHOW = 3  # photos: a point or pixel that fewer show tells nothing

# What files may hold.
MOST_SIDE = 65_535  # px: the largest that a JPEG can have; larger ones come from damaged files
LARGEST = 1e15  # world units; beyond this, squared distances overflow 32-bit floats
# px: small copies of photos and frames, which tell of axes and of sharpness; cameras for photos that are
# scaled down to no more need not be finer than such photos tell.
COPY_SIDE = 640

# From photos on disk to views, and to photos that are stored for COLMAP.
JPEG_QUALITY = 95
SMALLEST_SIDE = 8  # px; below this no metric or tile means anything
MAX_WORKERS = 4  # photos at their stored size at once
KEPT_SIDE = 800  # px, of the photos beside cameras.json: to look at, not to train

# Where cameras stand, and which way up.
SHOWN = 0.02  # of a photo's sides, which its points must span, and of a face, which its photo must show
SMALLEST, USUAL = 0.25, 4.0  # sizes, world units: the least ordinary one; what others are brought to
ONE_PLACE = 1e-12  # of the distance from the origin: what differs by less is in one place, but for rounding
BACKGROUND = (0.0, 0.0, 0.0)  # RGB behind everything, in renders and cut-out photos, unless asked for

# Camera paths.
PATH_SIZE = 504, 378  # px (of photos of built-in rooms too), where nothing else is said

# Similarities between frames.
OUTLIER = 3.0  # times the usual error, or robust standard deviations: what lies farther off is no scatter
ROUNDING = 1e-9  # residuals and shares below it are none

# GPS: what is asked of it before it tells a scale.
GPS_LEAST = 4  # photos with a place
