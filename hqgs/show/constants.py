"""The numbers of what people look at: pages, the viewer, films. They were chosen by eye.

Those of maps of trust were fitted, and are in `hqgs.show.trust`; the layout of charts is beside them.
"""

# Films.
FPS = 30.0
MOST_CAMERAS = 200  # to jump to in a page; that the viewer draws, evenly chosen
# Frames that say which depths a film shows; ends of its colours.
DEPTH_SAMPLES, DEPTH_PERCENTILES = 8, (2, 98)

# Maps of errors, and of trust.
WORST_SHOWN = 64.0  # levels, of the brightest or reddest pixel

# Exported files.
BAND_SHARE = 1e-3  # of the Gaussians: a band that no more of them use is left out for all
CHANGE_VIEWS = 4  # renders that tell what a file changes, as large as photos beside cameras.json

# report.html, and judge.html.
PAGE_GAUSSIANS = 400_000  # in a page, at most
GAUSSIANS_A_SET, MOST_SETS = 8, 1 << 13  # of harmonics: 50,000 Gaussians of degree 3 take less than 3 MB
BAND_COVERED = 0.999  # of a band's coefficients that its largest stored value covers
WORST_PAIRS = 12  # photos with pictures in judge.html
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
