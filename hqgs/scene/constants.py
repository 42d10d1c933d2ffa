"""The numbers of scenes, each with its meaning and unit. Those of finding cameras stand
beside their use; what a built-in room is like is told beside it.

Limits keep damaged files and short memory out; what decides between good inputs was tried on the captures of
the tests and on fern, fox and horns; those of GPS were set by hand.
"""

# Every scene.
TEST_EVERY = 8  # views: each 8th by name is held out (Mildenhall et al. 2019), where nothing else is said
FEWEST_PHOTOS = 5  # with fewer none is compared with the others
ENOUGH_SHOW = 3  # photos: a point or pixel that fewer show tells nothing
STRAY = 10.0  # median distances from the cameras' middle: one so far off says nothing of a scene's size
PICTURE_MARGIN = 1.15  # of the half field of view: a Gaussian just outside the picture still reaches into it

# What files may hold.
MOST_SIDE = 65_535  # px: the largest that a JPEG can have; larger ones come from damaged files
LARGEST = 1e15  # world units; beyond this, squared distances overflow 32-bit floats
MOST_FRAMES = 100_000  # of a camera path in a file
MOST_BYTES = 4e9  # of all photos, where `longest` bounds them; 1,000 of 1600 x 1200 px would be 5.8 GB
# px: small copies of photos and frames, which tell of axes and of sharpness; cameras for photos that are
# scaled down to no more need not be finer than such photos tell.
COPY_SIDE = 640
SAME_POSE = 0.5  # px of a run's photos; COLMAP moves them by far more where one of them is gone

# From photos on disk to views, and to photos that are stored for COLMAP.
JPEG_QUALITY = 95
SMALLEST_SIDE = 8  # px; below this no metric or tile means anything
MAX_WORKERS = 4  # photos at their stored size at once
KEPT_SIDE = 800  # px, of the photos beside cameras.json: to look at, not to train

# Where cameras stand, and which way up.
FAR_OFF = 20.0  # median distances: from here on a camera is asked what of the points it shows
# Of a photo's sides, which its points must span, and of a face, which its photo must show; points.
SHOWN, LOOKED_AT = 0.02, 1000
SMALLEST, GREATEST, USUAL = 0.25, 256.0, 4.0  # sizes, world units: ordinary ones; what others are brought to
ONE_PLACE = 1e-12  # of the distance from the origin: what differs by less is in one place, but for rounding
FAR_ORIGIN = 16.0  # sizes from the origin: from here on it is moved, before float32 is 1e-3 of 1,000 px off
AXES_PAIRS = 6  # of neighbours, spread over the photos
AXES_FEWEST, AXES_CLEAR = 30, 3  # matches that must fit; times as many as with the stated axes
BACKGROUND = (0.0, 0.0, 0.0)  # RGB behind everything, in renders and cut-out photos, unless asked for
EMPTY = 255  # of `View.empty`: nothing of the pixel shows anything
RANDOM_POINTS = 20_000  # to start from where a scene has none

# Up, by upright edges; tried on the room and on 13 captures of others.
UP_CONE = 15.0  # degrees from how the photos were held, at most
UP_SURE = 1.0  # degrees: a wider 95 % interval is no answer
UP_PHOTOS = 24  # spread over the scene
EDGE_STEP = 0.01  # of white, for each px
EDGE_LENGTH, EDGE_WIDTH = 0.04, 5.0  # of a photo's longer side, least; px, most
EDGE_OFF = 0.7  # degrees, sigma, that an upright edge may be off
EDGES_FEWEST, EDGES_SHARE = 20, 0.3  # upright ones; their share of the length of those within UP_CONE
EDGES_CLEAR = 2.5  # times what meets in the directions around

# Camera paths.
# px (of photos of built-in rooms too), degrees, where nothing else is said.
PATH_SIZE, PATH_FOV = (504, 378), 60.0
MOST_WALKED, MOST_KEYS = 400, 24  # cameras that are put in order; that a path goes through: more shake it
LEAP = 10.0  # median steps: south 26, from one side of a house to another; films and walks around up to 7
TURN_EXTENT = 0.5  # of the cameras' extent: the way that counts as much as a turn of one radian

SOME_FACTORS = (0.5, 1.5)  # of a `some` step's value: the least and the most

# Similarities between frames.
ORIENTATIONS = 0.1  # weight of cameras' orientations beside their centres; decides where those are in line
HYPOTHESES = 100  # choices of two or three that are tried: enough where half of all are wrong
OUTLIER = 3.0  # times the usual error, or robust standard deviations: what lies farther off is no scatter
ROUNDING = 1e-9  # residuals and shares below it are none

# GPS: what is asked of it before it tells a scale.
GPS_LEAST = 4  # photos with a place
