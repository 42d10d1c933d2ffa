"""The numbers of how photos are made, by the file that uses them: what each means and its unit.

Those of a phone and of shaken hands are typical values, chosen by hand; no one camera was measured.
"""

from __future__ import annotations

import math

# blocks.py: the 8 x 8 blocks in which JPEG and films store pictures
# Of blocks, or coefficients that are not zero: with fewer no estimate is made; fewer without clipped pixels,
# and all blocks are taken.
ENOUGH_BLOCKS = 40
MAX_BLOCKS = 4_000  # whose details are looked at

# camera.py: what a camera chooses anew for each photo: exposure and white balance
CAMERA_WHITE_BALANCE = 0.25  # of the range of stops: the range of red's and blue's gains against green's

# degrade.py: how photos get bad, as pure functions of photos and generators
CHAT_QUALITIES = (40, 70)  # of a messenger's JPEG: the lowest and highest, all equally likely

# edges.py: edges of a photo: the Sobel gradient magnitude, and the photo seen through it
# Sobel sums of equal numbers differ by rounding alone up to about this, times the largest |value|. 8-bit
# photos have steps of at least 1/255, far above it.
SOBEL_ROUNDING = 1e-5

# files.py: photo and mask files
LARGEST = 1 << 28  # px of a photo: more come from damaged files, and would fill the memory

# kernels.py: the kernels of defocus and motion blur
GOLDEN = math.pi * (3 - math.sqrt(5))  # radians from one seed of a sunflower, which fills a disc, to the next
KERNEL_REACH = 4  # sigmas at which the Gaussian kernel ends

# phone.py: a phone's camera in low light: from linear light to the JPEG file that it stores
FULL_WELL = 6000.0  # photoelectrons of white in green where no light is missing
READ_NOISE = 2.5  # electrons, standard deviation
# Gains of red, green and blue: the sensor sees white as 1/1.9, 1, 1/1.6.
PHONE_WHITE_BALANCE = (1.9, 1.0, 1.6)
# A bilateral filter over 5 x 5 pixels; its sigma in px, in deviations of the noise, and of the chroma's blur.
DENOISE_RADIUS, DENOISE_SIGMA = 2, 1.5
SHARPEN_SIGMA, SHARPEN_AMOUNT = 1.0, 0.8  # px and gain of the unsharp mask
PHONE_QUALITY = 70  # of the JPEG file, 4:2:0

# resize.py: antialiased bicubic resizing, as MATLAB's imresize defines it
CUBIC_A = -0.5  # of Keys's cubic: the value at which it reproduces quadratics
CUBIC_RADIUS = 2  # of the cubic, in samples
RESIZE_BAND = 8  # new rows at a time: what is between then fits into the caches

# shake.py: hand shake: a smooth random path through the exposure, and the kernel that it draws
WEAKEST = 0.2  # of the longest extent: how far the stillest photo moves
SHAKE_TURN = 0.6  # radians, standard deviation of the turn from one stretch of a path to the next
SAMPLES_PER_PX = 8  # along a path, at least; a kernel is a mean over them

# video.py: photos as a film
FPS = 30  # frames a second of films and camera paths, where nothing else is said
