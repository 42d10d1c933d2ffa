"""The numbers of measuring that several files go by. Where no source is named they were set by hand."""

# Means over photos.
CONFIDENCE = 0.9  # of every interval of a metric
SCATTER = 0.1  # dB: two runs that differ by no more are alike, as two seeds are

# Where an error comes from.
PATCH = 32  # px, of the map of errors
FINE = 2.0  # px: what a Gaussian of this deviation smooths away is fine detail
MOST_CAMERAS = 200  # evenly chosen, that stand for all: asked what they show; in a page; drawn by the viewer
FOG = 0.1  # of a pixel's colour from Gaussians that hang before the surface, and it lies behind fog

# Pictures.
AMPLIFICATION = 4  # times: so much larger differences are drawn
MASKED = 150, 158, 170  # difference where the mask leaves the photo out: no grey that a difference has
