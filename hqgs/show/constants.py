"""The numbers of what people look at: pages, the viewer, films. They were chosen by eye."""

# Films.
FPS = 30.0
DEPTH_SAMPLES, DEPTH_PERCENTILES = (
    8,
    (2, 98),
)  # frames that say which depths a film shows; ends of its colours

# Maps of trust.
DOUBTFUL = 64.0  # levels of error of the reddest pixel

# report.html.
PAIRS, PAIR_SIDE, SHEET_SIDE = 8, 720, 1080  # pictures of photo and render, best, worst and between; px
PAGE_QUALITY, PAGE_VIEWS = 82, 200  # of JPEG; cameras to jump to

# The viewer.
PORT = 8080
MAX_MESSAGE = 1 << 20  # bytes; what a page of ours sends takes hundreds
REST, GOAL = 0.2, 0.06  # s without a move, and the picture gets sharp; s for one while the camera moves
SHARP, COARSEST, STREAMED_SIDE = 800, 96, 2048  # px: heights of the picture, and the largest side
MOVED = 0.02  # radians, and of the distance: a camera nearer than that to a photo's sees the same
FRUSTUMS, THUMB = 150, 160  # training cameras that are drawn, evenly chosen; px of the photos at them
