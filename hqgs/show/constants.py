"""The numbers of what people look at: pages, the viewer, films. They were chosen by eye.

The layout of charts is beside them.
"""

# Films.
# Frames that say which depths a film shows; ends of its colours.
DEPTH_SAMPLES, DEPTH_PERCENTILES = 8, (2, 98)

# Maps of errors, and of trust.
WORST_SHOWN = 64.0  # levels, of the brightest or reddest pixel
TRUST_PHOTOS, TRUST_SIDE = 64, 400  # training photos that are looked at, at most; px, of their longer side
TRUST_ROUNDS = 4  # of the maximisation: more change the order of the pixels by less than its scatter
# Of a run's steps: more views are not passed over again for the page's map, but for those of so many photos.
TRUST_PASSES, TRUST_LEAST = 0.06, 4
PRIOR = 0.1  # error of a Gaussian (white is 1), as of one pixel's weight
EMPTY = 0.3  # error of what is behind everything
FLOOR = 0.002  # keeps ratios of errors finite: half a level
POWER, SCALE = 0.70, 0.52  # from what is carried to what SHARE of new pixels stay below: of three scenes
SHARE = 0.9  # of the pixels: what a bound promises
GOOD, LEAST_GOOD = 20.0, 0.005  # levels of 255: a pixel with such a bound is good; share of them that tells
NONE_GOOD = 1.00001  # of the factor at which the surest pixel is still called good: none is
CALIBRATORS, TRUST_TRAINED = 40, 8  # held-out photos that calibrate, and training photos beside them, at most
SEEN = 0.5  # pixels' weight that a Gaussian has in a photo that sees it
PATH_LOOKS = 32  # cameras of a path that are looked at, at most
# Before a run says better: how far a photo's PSNR lies from what its pixels' trust says, dB, and as how many
# photos that counts; and that a decibel of the one is a decibel of the other, as from photos whose squared
# distances from their mean add up to so many dB^2. Of ten runs' held-out photos, each judged by the others,
# 57 of 64 intervals hold; 18 of 21 in the three runs that had no part in the choice.
SPREAD, SPREAD_PHOTOS, SLOPE_WEIGHT = 1.5, 3, 5.0
HELD_AWAY = 0.25  # of the held-out photos stand nearer to a training photo than where a scene shows less
# Photographs next: photos around which places are tried, how far off in the usual distance to the next photo,
# px of a picture that tells how much is known, and dB below the photos' own places from which it is told.
SPOT_PHOTOS, SPOT_STEP, SPOT_SIDE, SPOT_WORSE = 24, 2.0, 120, 3.0

# Exported files.
BAND_SHARE = 1e-3  # of the Gaussians: a band that no more of them use is left out for all
CHANGE_VIEWS = 4  # renders that tell what a file changes, as large as photos beside cameras.json

# report.html, and judge.html.
PAGE_GAUSSIANS = 400_000  # in a page, at most
# Sets of harmonics: 50,000 Gaussians of degree 3 take less than 3 MB.
GAUSSIANS_A_SET, LEAST_SETS, MOST_SETS = 8, 1 << 11, 1 << 13
BAND_COVERED = 0.999  # of a band's coefficients that its largest stored value covers
DIFFERENCE_SHOWN = 16.0  # levels between two scenes: the deepest blue and red
PAIRS, PAIR_SIDE, SHEET_SIDE = 8, 720, 1080  # pictures of photo and render, best, worst and between; px
PAGE_QUALITY = 82  # of JPEG

# Lengths in the viewer.
CLICKED = 3  # px a side, of the little picture around a click
CLICK_ERROR = 1e-3  # radians: what a click is off
SOLID = 0.5  # alpha, least, of something that is clicked
THICKNESS_OF = 8  # Gaussians that tell how thick a surface is
BAR = 0.25  # of the picture's width that the bar takes at most
BAR_MARGIN, BAR_THICK, BAR_TEXT = 16, 4, 16  # px

# The viewer.
PORT = 8080
MAX_MESSAGE = 1 << 20  # bytes; what a page of ours sends takes hundreds
REST, GOAL = 0.2, 0.06  # s without a move, and the picture gets sharp; s for one while the camera moves
SHARP, COARSEST, STREAMED_SIDE = 800, 96, 2048  # px: heights of the picture, and the largest side
MOVED = 0.02  # radians, and of the distance: a camera nearer than that to a photo's sees the same
THUMB = 160  # px of the photos at the cameras that are drawn
