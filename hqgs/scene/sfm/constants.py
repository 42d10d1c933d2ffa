"""The numbers of finding cameras, by what they are for: what each means and its unit.

Where no source is named, the number was set by hand. It imports nothing of hqgs: `program.py` uses it in
COLMAP's process.
"""

import math

import pycolmap

# COLMAP's own: px from its epipolar line that a match may be; matches that agree, of a pair; of the nearest
# descriptor's distance to the second's, at most (Lowe 2004); focal length, in longer sides, where nothing
# tells; degrees between two rays to a point, least.
_pair = pycolmap.TwoViewGeometryOptions()
EPIPOLAR = _pair.ransac.max_error
MATCHES = _pair.min_num_inliers
LOWE_RATIO = pycolmap.FeatureMatchingOptions().sift.max_ratio
FOCAL = pycolmap.ImageReaderOptions().default_focal_length_factor
ANGLE = pycolmap.IncrementalMapperOptions().filter_min_tri_angle

# What is asked of photos and models.
LEAST_PHOTOS = 3  # of a scene or model: one alone shows no depth
LEAST_SHARE = 0.5  # of the photos must find their place in a model
ALMOST = 0.95  # of the photos: with fewer, they are looked at again, more closely
ENOUGH_PLACED = 0.7  # of the photos: with fewer, the second pass follows
FEW_FEATURES = 150  # a photo with fewer is blurred, or shows nothing that can be found again
POOR = 0.25  # of the features of the others: the same
ENOUGH_INLIERS = 30  # a pair with so many matches that one geometry bears out shows the same thing
BORNE_OUT = 0.85  # of matches between panoramas: 0.91 and 0.93 at right places, 0.68 and 0.79 at wrong ones
MIN_TRACK, MAX_ERROR = 3, 1.0  # a point needs so many photos, and may miss them by so many px on average
PROBED = 8  # photos that tell of all what files do not: how rich they are, whether they are panoramas
LEAST_AGREED = 0.3  # length of the cameras' mean up; shorter: they agree on none
FOLDERS_DEEP = 5  # below the one named in which photos are looked for: Takeout/Google Photos/Walk

# Time.
LONG, MANY = 60.0, 150  # s, photos: from where on the user is told before it begins
AGAIN = 4  # times the first pass, that all passes take at most
LISTEN, LOG_LOOKS = 0.25, 0.5  # s between looks at what COLMAP is doing, and into its log

# Features, and which photos are matched.
LARGEST = 1600  # px a side: features of larger photos cost minutes and place no camera better than that
COARSE = 2048  # features of a photo looked at coarsely (before those with two directions count twice)
RICH = 1000  # features (median of the probed photos) from where on coarse ones are enough
SIGMAS = (1.0, 1.5)  # px of what SIFT sees; of the smoothed versions
MATCHED_ALL = 60  # photos; of fewer each is matched with each
COMPARED = 256  # features of a photo, the largest, that tell its partners
PARTNERS, NEXT = 20, 4  # of a photo: those that are most like it, and those that follow it
FILM_NEAR, FILM_THIN = 10, 24  # frames of a film that are matched with the next ones, and each with each
DESCRIPTOR = 512  # length of COLMAP's descriptors, whole numbers
BLOCKS = 8  # of photos, squared: what matching tells its progress in, and goes on from when interrupted

# Panoramas.
PANORAMA_SEAM = 2.0  # times what neighbouring columns differ by: the last and the first of it are neighbours
PANORAMA_POLE = 0.35  # of the picture's contrast: its first and last rows show a point each
PANORAMA_PLAIN = 0.25  # the same: a border with less shows nothing
FINER = 4 / math.pi  # times a face's pixels: in its middle as fine as the photo, so that SIFT sees all of it

# Places by weaker evidence, and what photos say of places.
GATES = ((15, 0.15), (12, 0.1))  # matches with points that agree on a place, and their share of all; least
ALWAYS_CHECKED = 16  # photos, whose places are always checked
SEARCHED = 60  # points of each photo that the others are searched for, those that most photos see
DEVIATIONS, TIMES = 3.0, 1.5  # by which more must agree at the place than beside it; the same, as a ratio
# Points that a photo must show, or share with others, to be told by them; parts share 12 and 15 with the rest
# where they are wrong, 36 and more where right.
JOINT = 20
WEAKLY_JOINT = 60  # parts that share fewer are looked for in each other: two like sides of a house share 46

# What is left out, and adjusted.
ROUNDS = 3  # of patches, or of leaving out what lies far off, and adjustment
FEWER = 2  # of patches where features are precise already
FALSE = 2.5  # medians of the points' errors; what lies farther off is taken for a false match at last
UNSURE = 0.3  # px of what SIFT sees that observations are usually off, from where on photos may be bad
SELDOM = 1.3  # times the photos or points: until then, no adjustment of all that was found coarsely
POSE_LEAST = 4  # observations of a photo that tell a pose and more
RAYLEIGH = math.sqrt(2 * math.log(2))  # median distance of points in a plane that scatter by 1 each way

# Patches of points.
HALF = 6  # nodes of a patch to each side of its middle
WINDOW = 3.5  # nodes, sigma of the weights over a patch
SMOOTH = 1.0  # px, sigma, of the photos that patches are taken from
PATCH_SIDE = 1000  # px, of these photos, and of those in which tags are looked for
PATCH_STEPS, STILL = 5, 0.05  # of Gauss-Newton, at most; nodes, the usual step after which none follows
REACH = 3.0  # px that an observation may move
SURE, NEW = 0.6, 0.7  # correlation with the others' mean, of what stays; of what no feature told of
UNLIKE = 0.3  # of a photo's observations that are sure: with fewer, patches tell nothing of it
PATCH_PHOTOS = 12  # that a point is looked for in, beside those whose features show it
FRONTAL = 0.8  # cosine of the angle between a patch's normal and a new ray, least
COARSER = 2.0  # px of a photo in which a point is looked for, in px of the finest that shows it, most
LAID = 400  # observations of a photo, of the points whose patches are laid
CELL = 2.0  # px, where points are the same
ROUGH = 0.02  # of a patch's variance: what no patch fits better than, counted as noise
GROWN = 1.3  # times: patches that leave the observations so much farther off do not fit these photos

# Adjustment by the precision of each observation.
ADJUST_STEPS, LEVENBERG = 10, 1e-6  # at most; damping, of the diagonal
ROBUST = 2.0  # medians of the errors, scale of Cauchy's function
ALONG = 0.1  # of the usual precision; an observation that is less precise some way follows its point there
NUDGE = 1e-6  # of a depth or parameter, by which slopes are taken
# Of the cost: a step that gains less is the last; of the diagonal: what stays free.
SETTLED, TINY = 1e-5, 1e-12

# Frames laid onto each other.
HUBER, FARTHEST = 1.0, 1e3  # px from where on a distance counts linearly, and no more

# Points for known poses: cosine of the angle between the directions in which two of more must look, at least;
# points and px of the photos, below which there is no basis; s for a COLMAP that hangs.
ALIKE, POINTS_WANTED, TOO_SMALL, TRIANGULATION = 0.5, 200, 100, 1800.0
