"""The numbers of the diagnosis, by the file that uses them: what each means, its unit, what was measured.

Where a comment names no measurement, the number was chosen by hand, on captures as they are and as
`hqgs degrade` degrades them. Arrays are the grids that are searched.
"""

from __future__ import annotations

import numpy as np

# Of several files.
ROUNDS = 30  # of means and medians of photos and points in turn
LARGEST = 1024  # px a side: more of the middle of a photo is not looked at, but for its enlargement
LEAST_BLUR = 0.7  # px, a Gaussian's sigma; photos that count as sharp reach 0.6, at JPEG's quality 10 0.8

# blur.py: kind and size of a photo's blur from its power spectrum
SHARP = 0.3  # px: the sigma that the spectra of sharp photos fit; taken off in squares
BLUR_SIGMAS = np.concatenate([np.arange(0, 4, 0.05), 4 * 1.02 ** np.arange(70)])  # px, up to 16
RADII = np.concatenate([np.arange(1, 8, 0.1), 8 * 1.02 ** np.arange(57)])  # px of the disc, up to 24
BLUR_LENGTHS = 3 * 1.25 ** np.arange(13)  # px, of the motion
FINE_LENGTHS = 3 * 1.04 ** np.arange(69)  # px, around the best of them
ANGLES = np.arange(18) * np.pi / 18  # rad, of the motion
CLEARLY = 0.7  # a kind other than Gaussian must have less than this share of the Gaussian's misfit
# Of the log power: how far sharp photos are off the law; as points err together, each tells little.
RING_ERROR, POINT_ERROR = 0.2, 0.6
# levels^2: what JPEG of a quality too good to be found may have added; without them a blur of 2 px under
# quality 95 passes for a disc, one of 1 px under 92 for 0.7 px.
UNKNOWN_FLOORS = (0.0, 0.1, 0.3, 1.0)
PLANE_POINTS = 1_000  # frequencies at which motion is looked for

# choice.py: the training photos that a scene does without: broken, empty or far too blurred
WELL_SEEN = 0.98  # of the points of a blurred photo, without it
CHOICE_POINTS = 600  # of the scene's, evenly spread, that are looked for in the photos
MOST_TURNED = np.cos(np.deg2rad(45))  # between two rays to a point; beyond, it may be another side of a thing
CHOICE_SHARED = 0.5  # of a photo's points that another must see to be compared with it
CHOICE_LEAST_BLUR = 2.0  # px, sigma of a Gaussian
UNUSUAL = 4.0  # robust standard deviations of sigma^2 over the scene

# coefficients.py: blur and noise under JPEG, from the quantised coefficients alone
DCT_SLOPE, DCT_SLOPE_SPREAD = 2.55, 2.0  # of the power over frequency; the spread is that of one block
VARIANCES = 13 * 6.0 ** np.arange(-1, 8)  # levels^2: of the lowest coefficient, one per class of blocks
MAGNITUDES = np.array([1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80, 112, 160, 226, 320, 452])  # in steps
EM_STEPS = 12  # rounds of expectation and maximisation over the classes of blocks
LIKELIHOOD_GAIN = 8.0  # nats that noise must bring, or there is none
SHOWS = 0.32  # times the mean of the three finest steps: the least noise that is told from fine texture
DCT_LEAST = 6.0  # levels; below it fine texture is taken for noise at any table

# devices.py: what cameras do to all their photos: vignetting and response
# Of the error of held-back photos' colours: from so much less on, it is learned. Photos of one camera reach
# 0.3 % and, taken for two, 7 % (a film, every second frame of it coarser); the room's 9 to 20 and 24 to 30.
PAYS = {"vignetting": 0.05, "response": 0.1}
DEVICE_PHOTOS, DEVICES_MOST = 4, 16  # that a camera must have taken; cameras that are told apart
DEVICE_VALUES = 12_000  # colours of points in photos that are looked at
DEVICE_ROUNDS, DEVICE_WEIGHTED = (8, 4)  # of means over photos and points in turn; of weights
DEVICE_RIDGE = 1e-4  # of the weights: what no photo tells stays 0

# differences.py: whether photos differ in sharpness, each in a direction of its own, or in their gains
UNLIKE, TURNED = 0.18, 0.45  # from these values of `Unlike` on, photos were shaken
UNLIKE_GAINS = 0.05  # of the log gains
SECTORS = 8  # directions of frequencies
UNLIKE_COARSE, UNLIKE_FINE = (0.03, 0.1), (0.15, 0.4)  # frequencies, cycles per px

# film_traces.py: traces of a film's codec in a frame: the levels that its luma had
LUMA_709 = np.array([0.2126, 0.7152, 0.0722])  # of films in HD (ITU-R BT.709); LUMA is that of the others
STEP = 255 / 219  # levels: of the luma of 8 bits from 16 (black) to 235 (white), which films store
DECODED = 0.35  # decoded frames have 0.48 and more, frames made smaller since 0.15 at most, photos 0.02
FEWEST_PIXELS, FEWEST_LEVELS = 10, 48  # of each level of the luma that counts, and of these

# focus.py: whether photos were focused each in its own way: by how sharply they show the same points
GOES_WITH_DEPTH, DIFFERS = 0.06, 0.4  # from these values of `FocusSigns` on, photos differ in focus
MOST_PHOTOS, FOCUS_MOST_POINTS = 60, 4000  # that are looked at
FEWEST_POINTS = 40  # of each photo on average
# px: sigmas between which details lie, and the window around a point
FOCUS_FINE, FOCUS_COARSE, FOCUS_WINDOW = 0.8, 2.4, 9
FOCUS_LARGEST = 2000  # px: the longest side of what is looked at of a photo
FOCUS_DARK = 0.5 / 255  # contrast below which there is nothing to be sharp
NEARNESS = (0.2, 3.0)  # that count; the photo's median depth has 1
FOCUS_LEAST = 0.25  # added to the sum of squares of a photo's nearness: few points tell no slope

# gains.py: the gain of each photo, from the colours in which the photos show the same points
GAINS_GRID = 2.0**-24  # of the logarithms of gains
GAINS_WINDOW = 5  # px around a point, whose mean is its colour there
# of white in linear light: beyond them noise and the sensor's white tell nothing
GAINS_DARK, BRIGHT = 0.02, 0.9
MOST_VALUES = 8_000_000  # photos times points that are looked at: 200 MB a table
GAINS_LENGTHS = (0.1, 0.2, 0.4, 0.8, 1.6)  # over which gains may go together, see `_apart`
SHARES = (0.25, 0.5, 0.75, 0.9, 0.97, 0.99)  # of their variance that does
GAINS_DOUBT = 3.0  # of the log-likelihood: less does not tell neighbours that go together from chance
OPPONENTS = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # of red, green and blue

# jpeg_traces.py: traces of JPEG: the blocks, and the quantisation table that the coefficients still show
COMB_MAX_BLOCKS = 200  # looked at; they are spread over the photo
MIN_FREQUENCIES = 4  # in which coefficients must show: few repeat in a drawing
COMB_MIN_EVIDENCE = 0.5  # nats per coefficient; photos that were never JPEG have -0.25, quality 90 has 0.8
SPREAD = 0.4  # levels: standard deviation of a decoded coefficient, as pixels were rounded twice
OUTLIERS = 0.02  # share of coefficients off the comb, in blocks that were clipped
BLOCKING_SEEN = 0.15  # above this a grid that does not begin at the corner is looked at too
STEPS = 255  # the largest step of an 8-bit JPEG

# noise.py: level of a photo's noise, and how neighbours go together in it
LARGE_PATCH, SMALL_PATCH = 5, 3  # px
FEW_PATCHES = 4_000  # below this the large patch has too many directions for the photo
LIMIT, SMALL_LIMIT = 2.5, 4.0  # levels: photos of fine texture without noise reach 1.9, small ones 3.2
MIN_PATCHES, MAX_PATCHES = 200, 12_000  # that are needed, and that are looked at
HALF_TILE = 24  # px: the photo is cut into a chessboard of tiles of this size
NOISE_BLOCK = 16  # px a side: blocks without clipped values tell how neighbours go together
NOISIEST = 0.05  # share of the blocks that show noise and little else

# photo.py: what one photo shows, from the last step of its making back to the first
SHARPER = 0.2  # px of the small photo: shrinking halves a camera's own softness or more, to 0.45 at most
HIDING_QUALITY = 92  # from this quality on, JPEG leaves the luma's noise and spectrum as they were
PHOTO_FEW_BLOCKS = 1_000  # of all photos together, to look for noise in the luma alone
LUMA_TELLS = 100  # px a side; the coefficients of smaller photos have the fine texture of large ones

# resolution.py: was a photo enlarged, and by how much?
FACTORS = (2, 3, 4, 6, 8)  # of enlargement that are tried
GRID_MIN_EVIDENCE = 2.1  # JPEG blocks reach 1.8 at factor 2; bicubic enlargement kept in 8 bits starts at 4.5
LONGEST = 768  # px of a line that are looked at
ROUNDING = 0.05  # levels; a residual below this counts as this

# scene.py: what degraded the photos of a scene, and which parts of the method that calls for
PROBES = 4  # photos searched for enlargement; if they agree, the others are taken to be like them
UNLIKE_NOISE = 2.5  # times the noise of the quieter photos in the noisier ones: each has its own
SCENE_WHITE = 0.2  # up to this correlation of neighbours, noise counts as white
# JPEG is undone below the first quality, or below the second where blur, noise or an enlargement is undone.
# What that gains (400 px, 1,000 iterations, held back; horns of 23, fox of 12, a cat of 6, fern of 14, a
# street of 21, a wheel of 8 photos), dB: alone, quality 30 -.78 -.45 -1.31 -.01 -.08 -.56; 20 -.52 +.16 +.49
# +.04 -.22 -.11. Qualities of 55 to 70, fox and cat: chat +.51 +.16, phone +.33 +.49, noise of 12 levels +.11
# -.16, blur -.05 +.58, shake -.04 +.23.
BAD_QUALITY, VISIBLE_QUALITY = 25, 85
# Of `fine_detail`; crf 36 leaves 0.15 to 0.25, crf 28 0.2 to 0.45, sharp photos have 0.3 to 0.5.
COARSE_FILM = 0.24

# sharpness.py: what the choice of photos keeps of each photo's pixels
CHOICE_SIGMAS = np.arange(-3, 10.01, 0.25)  # px; below 0: sharper than the others
CHOICE_DOUBT = 2.0  # of the log-likelihood: two standard deviations
FLAT_LEVELS = 3.0  # that a block may be off the colour of an empty photo
FLAT_SHARE = 0.99  # of the blocks of an empty photo

# spectrum.py: power spectrum of a photo and the law that photos follow: power falls like 1 / frequency^a
FLOOR = 0.03  # levels^2: what rounding to 8 bits leaves in the luma; nothing below it is believed
SPECTRUM_SLOPE, SPECTRUM_SLOPE_SPREAD = 2.4, 0.35  # of the power, over photos that count as sharp
MOST_TILES = 12  # along a side of a large photo
SHARED_TILES = 3  # tiles along the shorter side, before their overlap
SMALLEST_TILE, LARGEST_TILE = 32, 128  # px
HIGHEST = 2.7  # rad/px; above it cameras and resizing leave their own mark
NEWTON_STEPS = 8  # of the fit of the law
