"""The numbers of measuring, by what they are for: what each means, its unit and where it comes from.

Where no source is named they were set by hand: what parts an error has is a convention, and pictures were
chosen by eye.
"""

# Means over photos.
CONFIDENCE = 0.9  # of every interval of a metric
# The deviation of photos' values within a scene, its median over nine captures, and the deviation of its log
# between them: what a few photos that happen to agree are held against.
SPREADS = {"psnr": 2.0, "psnr_aligned": 2.0, "ssim": 0.025, "haarpsi": 0.04}
SPREAD_LOGS = 0.7
SCATTER = 0.1  # dB: two runs that differ by no more are alike, as two seeds are
HAARPSI_MIN_SIZE = 16  # px: the coarsest Haar filter
LPIPS_MIN_SIZE = 63  # px: AlexNet's smallest input
KEPT_BYTES = 256e6  # of renders that are held; 12 of 1600 x 1067 px

# Where an error comes from.
PATCH = 32  # px, of the map of errors
FINE = 2.0  # px: what a Gaussian of this deviation smooths away is fine detail
MOST_CAMERAS = 200  # evenly chosen, that stand for all: asked what they show; in a page; drawn by the viewer
BEFORE = 0.75  # of the depth in its pixel: a Gaussian nearer than that hangs before the surface
FOG = 0.1  # of a pixel's colour from such Gaussians, and it lies behind fog
WORST, LEAST = 3, 0.005  # photos that the screen names; share of the error that is named

# Fitted cameras, by Levenberg's steps: those turned by 1.5 degrees come home (`tests/test_fit_cameras.py`).
SMOOTHED = (3.0, 1.0, 0.0)  # px; coarse to fine, so that a camera may be several pixels off
FIT_STEPS = 10  # at each of them, at most
DIFFERENCE = 0.3  # px by which a camera is moved to see what that changes
SETTLED = 1e-4  # of the squared error; less gained ends a level

# Pictures.
AMPLIFICATION = 4  # times: so much larger differences and trajectories are drawn
PNG_LEVEL = 2  # a tenth larger than zlib's default makes it, in two thirds of the time
MASKED = 150, 158, 170  # difference where the mask leaves the photo out: no grey that a difference has
SHEET_PHOTOS = 12  # on a sheet or in judge.html, at most
TILE_SIDE = 260  # px, of a photo on a sheet
CAPTION = 18  # px
