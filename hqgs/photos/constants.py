"""The numbers of how photos are made, by the file that uses them: what each means and its unit."""

from __future__ import annotations

import math

# blocks.py: the 8 x 8 blocks in which JPEG and films store pictures
# Of blocks, or coefficients that are not zero: with fewer no estimate is made; fewer without clipped pixels,
# and all blocks are taken.
ENOUGH_BLOCKS = 40
MAX_BLOCKS = 4_000  # whose details are looked at

# edges.py: edges of a photo: the Sobel gradient magnitude, and the photo seen through it
# Sobel sums of equal numbers differ by rounding alone up to about this, times the largest |value|. 8-bit
# photos have steps of at least 1/255, far above it.
SOBEL_ROUNDING = 1e-5

# files.py: photo and mask files
LARGEST = 1 << 28  # px of a photo: more come from damaged files, and would fill the memory

# kernels.py: the kernels of defocus and motion blur
GOLDEN = math.pi * (3 - math.sqrt(5))  # radians from one seed of a sunflower, which fills a disc, to the next
KERNEL_REACH = 4  # sigmas at which the Gaussian kernel ends

# resize.py: antialiased bicubic resizing, as MATLAB's imresize defines it
CUBIC_A = -0.5  # of Keys's cubic: the value at which it reproduces quadratics
CUBIC_RADIUS = 2  # of the cubic, in samples
RESIZE_BAND = 8  # new rows at a time: what is between then fits into the caches

# video.py: photos as a film
FPS = 30  # frames a second of films and camera paths, where nothing else is said
