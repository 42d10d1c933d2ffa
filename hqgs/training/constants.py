"""The numbers of training, each with its meaning, its unit and where it comes from.

Where no source is named, the number was chosen on held-back training photos of fern, fox and horns at half
size; test photos were looked at only where it says held-out. Those of 3DGS's densification are the defaults
of `DensifyConfig`.
"""

import math

# The plan: points to start from, budget, length.
PIXELS = 100  # of the photos, for each point to start from where they are as photographed
# A run of fewer steps for each photo starts from twice as many points where photos agree on this share.
# Held back, in 1,000 steps, 11 to 22 for each, by that share: 0.84 (a building) +0.54, 0.77 (a statue) +0.15,
# 0.68 (a can) -0.55, 0.66 (a bedroom) +0.03 dB, for a fifth more time.
FEW_STEPS, POINTS_AGREED = 20, 0.72
TIMES_OWN_POINTS = 1.5  # the scene's own points so many times at least
NOISE_HALVING = 6.0  # levels of noise at which two pixels tell what one does without noise
# Levels of noise that the codec of a coarse film counts as. On fern, fox, horns and the room (168 px,
# `video:36`, 500 steps, held-out photos, one seed) +0.4 dB to none, +0.9 to 3dgs; in 2,000 steps +0.1 or so.
# By photos held back, at `video:40` (fox, the room) twice as much gains nothing; at `video:28` none is 0.15
# dB better than this (mean of the four), 0.6 on horns, where 10 levels win 0.1 of that back.
FILM_NOISE = 20.0
DETERMINED = 600.0  # Gaussians under noise, times the cube root of the pixels' worth of photos
# So many iterations are enough where cameras are learned, and where photos are as photographed so many for
# each, LEAST_ENOUGH at least. More learn what no other photo shows: fern (13 photos, half size) comes to
# 30.02, 30.00, 29.76 dB in 2,000, 4,000, 7,000; fox at stored size loses 0.5 dB from 7,000 to 9,250.
ENOUGH, FOR_EACH_PHOTO, LEAST_ENOUGH = 7_000, 150, 4_000
GROWS_FROM = 140  # the iteration before which a run from points all over the photos does not grow
# A mean step of a run over one at its start, and with DENSE times the scene's own points and more: such a run
# grows little, and its Gaussians hide more of each other as they become opaque. Measured on four captures.
SLOWER, SLOWER_DENSE, DENSE = 2.0, 1.0, 2
FEWEST_ITERATIONS, MOST_ITERATIONS = 50, 30_000  # of a run that has a number of seconds
CLOCK_LEAST, CLOCK_MOST = 0.1, 4.0  # of the rest of such a run as it was planned, by the clock
WARM, TIMED = 3, 7  # steps of each size before it: the first ones start threads and fill caches

# The frame of training, in which a scene has the size USUAL. Rounding of the files below 1e-10 of it crosses
# a step of the grids once in many thousand points; 5e-7 of a turn are 1e-3 px at a focal length of 2,000 px.
# CAMERA_GRID is that of all poses in training: far above what two makes of BLAS differ by.
POSE_GRID, POINT_GRID, CAMERA_GRID = 2.0**-20, 2.0**-16, 2.0**-30

# The schedule.
COARSE_PART, COARSE_MOST = 0.6, 1_500  # of the run, and iterations, at the smaller size, at most
COARSE_FACTOR, SMALLEST_SIDE = 2, 32  # of the sides; px that are left
HELD_SHARE, MOST_HELD, FEWEST_VIEWS = 1 / 20, 4, 10  # of the training views; with fewer none is held back
FINEST = 1.7  # px of the photo that sees a Gaussian best: with a larger standard deviation it may still grow
BAND_INTERVAL, SHORT = 1 / 20, 3_000  # of a run of more iterations, at most, until the next degree is trained
EVALUATED = 0.1  # of the pixels that are trained: those of the evaluations on the way, at most
EVALUATIONS_APART = 50  # iterations, unless asked for: each evaluation takes as long as some steps
TAIL, TAIL_PART = 50, 1 / 3  # steps after the end of growth that tell what the rest costs; of that rest
FASTER, LAST_OF_FIRST = 2.0, 1 / 3  # at most, of the rates of short runs
# Of the run, its last steps, whose mean is the scene: 2.5 % +0.09, 5 and 10 % +0.11, 20 % +0.06 dB.
SHOWN_PART = 0.05
REST = 0.5  # of what came before: the length of what follows; in the first half of it the scene still grows
# Iterations between looks at whether the run still improves; dB and iterations: when it has stopped.
CHECKS, BETTER, PATIENCE = 500, 0.05, 2_000

# Few photos. Measured on 25 sets of 3 to 43 photos of 14 captures and rooms, 1,000 iterations at 400 px. With
# at most 12 photos decay gained in all 10 sets, 0.05 to 1.3 dB. From 13 to 31 it gained 0.3 to 1.4 dB in 8
# sets whose photos agreed on less than 0.89 of the depths, nothing in one, lost 0.5 in one; nothing in the
# two that agreed on more (fern loses 0.4 dB in 2,500 iterations). More photos than MANY_PHOTOS lose as much
# in a look at all as that many do. Held back, 1,000 iterations: +0.35 (103 photos, which agree on 0.68),
# +0.26 (63, 0.77), +0.30 (53, 0.69), -0.2 dB (fox, 36, 0.85); in 4,000 +0.08 (103) and +0.7 (53). As much for
# each view as with few photos loses 1.9 dB there with 103.
# First points found back gained 0.6 to 1.5 dB on 6, 8 and 12 photos, 0.2 on 17, lost 0.1 on 25 to 60.
# Degraded photos (chat, noise:25, blur, jpeg:10; 400 px, 1,000 iterations, held back) gain by both: a wheel
# of 8 +0.9, a cat of 6 +1.5, foxes of 12 +0.9, a street of 21 +1.4, a museum of 6, where each photo shows
# another part, -0.6 dB (HaarPSI +0.02). By points alone: horns of 16 +0.4, fern of 14 0.0. By decay alone in
# 4,000: noise:25 +0.5 to +0.9 (a wheel, a cat, fern, horns of 16), chat +0.2, +0.5, +0.2, jpeg:10 +0.3 (foxes
# of 18, horns of 16, fern, fern; agreed 0.86 to 0.91). Blur and lowres:4 alone, which leave less to hold fine
# detail up: a cat of 6 +1.1; horns of 16 (agreed 0.88) -0.2, 0.0, foxes of 18 (0.86) -0.3, fern -0.1 (0.90),
# -0.3 (0.89; 504 px, held-out photos), SSIM -0.010 to -0.023.
# More than MANY_PHOTOS, share as above, 4,000: noise:25 +0.5, +0.2 (horns of 46, foxes of 36), chat +0.2 and
# in 2,000 jpeg:10 +0.1 (foxes), +0.3 (horns).
FEW_PHOTOS, MANY_PHOTOS, DEPTHS_AGREED, SOFT_AGREED, MANY_AGREED = 12, 31, 0.89, 0.85, 0.8
DECAY = 0.005  # share of the opacities that each view takes away (Han et al. 2024: 0.995 of them stay)
# FEW_PHOTOS at most, which found their own cameras, grow to so many Gaussians for each point that they agree
# on, or one for so many pixels. Held back, three sets each of a museum (8 photos, 388 points) and a wheel
# (10, 693): +1.1 to -0.03 dB, SSIM +0.06 to +0.01. Better cameras bear more: horns of 3 and 6 photos, which
# all 62 placed, -0.22 and -0.02 dB, SSIM -0.012, -0.005; the room of 8 0.0, -0.013.
POINT_GAUSSIANS, PIXELS_EACH = 40, 50
DROPOUT = 0.2  # share of Gaussians left out of a step, at the end of the run (Park et al. 2025)
DROPOUT_PHOTOS = 10  # up to which it gained beside decay: 0.3 to 1.0 dB (alone it lost 0.4 with 12)
OPAQUE = 0.999  # opacity that dropout raises a Gaussian to, at most: its logit stays finite
DROPPED = -20.0  # logit of a dropped one's opacity, 2e-9: no pixel blends it

# 3DGS (Kerbl et al. 2023): the weight of D-SSIM beside L1 (equation 7); children of a Gaussian that is split,
# and what its scales are divided by (section 5.2; its code).
LAMBDA_DSSIM = 0.2
SPLIT_CHILDREN = 2

# Passers-by, by a small scene of small photos. CONTRADICTED was chosen on walkers in the room, fern, horns,
# whose regions score 0.6 in the median. Of 217 regions that differ in the room, fern, horns, fox, can and
# drinks without walkers none scores more than 0.28; of 71 smaller ones 3 do.
SCOUT_SIDE, SCOUT_CELL = 160, 2  # px: of the copies, and of the cells whose mean colours are compared
SCOUT_STEPS, SCOUT_STEPS_EACH = 200, 4  # so many, or so many for each photo where that is more
SCOUT_PIXELS, SCOUT_DEGREE = 50, 1  # of the copies, for each first point; of the harmonics
DIFFERS, DIFFERS_MUCH = 0.06, 0.12  # of white: what counts, and what a region must reach somewhere
SMALLEST_PASSING = 20  # cells of a region
DEPTHS_ASKED = 0.92, 1.08  # of the scene's: between them other photos are asked
CONTRADICTED = 0.3  # of a region's cells: so many more look as in the scene than as in the photo
BORNE_OUT = 0.5  # of them: most look as in the scene; where neither is borne out, photos only fail to agree

# The guard. Larger numbers count as not finite too: Adam keeps their squares, which overflow 32 bits.
GUARD_LIMIT = 1e18
LOG_LIMIT = math.log(2.0**128)  # of the scales' logarithms: exp of more overflows 32 bits
EVENTS_KEPT, GAUSSIANS_LISTED = 20, 10  # the first events, and the first Gaussians that an event names
MAX_SKIPPED_IN_A_ROW = 20  # steps; one bad view may pass, a broken run should not go on for hours

# Cleaning: 300 steps gain 1.0 dB on the room of 8 photos, 600 gain 1.2; half the decay takes twice the steps.
CLEANING_STEPS, CLEANING_DECAY = 600, 0.01  # the share of the opacities that each step takes away
FRAME_PHOTOS = 16  # training photos, at most, that tell whether scene and cameras are in the same frame

# The loss under noise. Up to KNEE standard deviations differences count by their square (Huber), half as
# steep there as L1 on average, and growth goes by the gradient: hence STEEPER.
KNEE, STEEPER = 2.0, 2.0
HELD_PIXELS = 50  # one of so many is held back under noise
PLATEAU_STEPS = 200  # from one look at them to the next, at least; without a gain the rates are halved
SIZES_REFRESH = 100  # steps until the sizes of the smallest Gaussians are computed again

# Cameras of each photo: shares of the run before which trajectories would hide what the scene does not show
# yet, at which short ones are given up, and of the rates at the end.
CAMERAS_BEGIN, GIVE_UP_AT, CAMERA_RATES_LEFT = 0.1, (0.5, 0.75), 0.1
SHORTEST_TRAJECTORY = 0.7  # px, of the picture's middle, and the widest disc: a photo with less is sharp
# Of the photo's width, standard deviation and radius: from 0 neither has a direction to grow in.
FIRST_TRAJECTORY, FIRST_RADIUS = 1e-3, 0.0015
TRAJECTORY_RATE, LENS_RATE, GAIN_RATE = 8e-4, 4e-4, 0.005  # of the photo's width, twice; of the log gains
DEVICE_RATE = 0.001  # of vignetting and response, which each photo of a camera moves
NARROW = 200  # px: narrower photos count as that wide
TRAJECTORY_POINTS = 9  # that stand for a trajectory
WARP_SPACING, MOST_WARPS = 1.5, 17  # px of a trajectory between samples of the exposure; and samples
MOST_MARGIN = 48  # px around a render
DEPTHS_REFRESH, DEPTHS_COARSER = 8, 4  # visits of a photo until its depths are rendered anew; px, as coarsely
SATURATED = 254  # levels of 1/255
LENS_NEAREST, LENS_FARTHEST = 2.0, 0.3  # nearness of what photos show, as far as sizes of discs go
FEWEST_SAMPLES, MOST_SAMPLES = 6, 24  # of the aperture

# The paper's form.
SCS_WEIGHT = 5.0  # in L = L1 + 5 L_SCS
SCS_CACHE_BYTES = 2**30  # of its weights (12 bytes a pixel); those of further views are computed at each step
# A render dimmer than this part of its target counts as this bright. The gradient of a cosine grows with
# 1 / |render|: without a floor one faint Gaussian in a black render would get any gradient at all.
DIMMEST = 0.01
ESFG_HIDDEN = 64  # units of the one hidden layer of an MLP; the paper names no size
