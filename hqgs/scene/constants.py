"""The numbers of scenes, each with its meaning and unit. Those of COLMAP and of built-in rooms are there.

Limits keep damaged files and short memory out; what decides between good inputs was tried on the captures of
the tests and on fern, fox and horns.
"""

# Every scene.
TEST_EVERY = 8  # views: each 8th by name is held out (Mildenhall et al. 2019), where nothing else is said
MOST_DEPTHS = 1 << 22  # that `Scene.reach` looks at: they and their median take some 120 MB
STRAY = 10.0  # median distances from the cameras' middle: one so far off says nothing of a scene's size
PICTURE_MARGIN = 1.15  # of the half field of view: a Gaussian just outside the picture still reaches into it

# What files may hold.
MOST_SIDE = 65_535  # px: the largest that a JPEG can have; larger ones come from damaged files
MOST_PIXELS = 1 << 28  # of a camera in a file
LARGEST = 1e15  # world units; beyond this, squared distances overflow 32-bit floats
LENS_SHARES = 1000  # focal lengths and principal points in sides of the photo; damaged files go far beyond
MOST_FRAMES = 100_000  # of a camera path in a file
LIST_BYTES = 1 << 24  # of a list of names
MOST_BYTES = 4e9  # of all photos, where `longest` bounds them; 1,000 of 1600 x 1200 px would be 5.8 GB
COARSE = 640  # px: cameras for photos whose longer side is scaled down to no more need not be finer than that

# From photos on disk to views, and to photos that are stored for COLMAP.
JPEG_QUALITY = 95
STRAIGHT = 0.01  # px: a camera this close to a pinhole is one, and its photo is not resampled
SMALLEST_SIDE = 8  # px; below this no metric or tile means anything
BAND = 1 << 20  # pixels mapped at a time, to bound memory
MAX_WORKERS, GIVEN_BACK = 4, 10  # photos at their stored size at once; after which freed memory is given back
DENSER = 2.0  # new pixels a wanted one, along each side, at which a photo is undistorted
LATTICE, EXACT = 8, 0.02  # px of such a grid: positions are computed so far apart, if that is exact enough
# Pixels of the photo between samples: where they are farther apart, means come first; and at which it may be
# decoded: 6000 px go to 1600 by way of 3000.
FAR_SAMPLES, DENSE_SAMPLES = 1.25, 1.75
FILM_SHRUNK = 1.5  # times: until then a smaller frame shows as much of the film's codec as at its own size
KEPT_SIDE = 800  # px, of the photos beside cameras.json: to look at, not to train

# Where cameras stand, and which way up.
FAR_OFF = 20.0  # median distances: from here on a camera is asked what of the points it shows
SHOWN, LOOKED_AT = 0.02, 1000  # of a photo's sides, which the points must span at least; of points
SMALLEST, GREATEST, USUAL = 0.25, 256.0, 4.0  # sizes, world units: ordinary ones; what others are brought to
ONE_PLACE = 1e-12  # of the distance from the origin: what differs by less is in one place, but for rounding
FAR_ORIGIN = 100.0  # sizes from the origin: from here on the origin is moved
AXES_PAIRS, AXES_LONGEST = 6, 640  # of neighbours, spread over the photos; px of the copies that are matched
AXES_RATIO = 0.8  # of the nearest descriptor's distance to the second's, at most (Lowe 2004)
AXES_NEAR = 3.0  # px from the epipolar line: a match fits
AXES_FEWEST, AXES_CLEAR = 30, 3  # matches that must fit; times as many as with the stated axes
RANDOM_POINTS = 20_000  # to start from where a scene has none

# Camera paths.
PATH_SIZE, PATH_FOV = (504, 378), 60.0  # px, degrees, of a camera where nothing else is said
MOST_WALKED, MOST_KEYS = 400, 24  # cameras that are put in order; that a path goes through: more shake it
TURN_EXTENT = 0.5  # of the cameras' extent: the way that counts as much as a turn of one radian
