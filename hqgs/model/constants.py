"""Numbers that all of the model goes by."""

import math

SH_C0 = math.sqrt(1 / math.pi) / 2  # the constant basis function
MAX_SH_DEGREE = 3
LEAST_SCALE = 1e-30  # that files are read with: a scale of 0 has no log
