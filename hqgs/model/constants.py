"""Numbers that all of the model goes by."""

SH_C0 = 0.28209479177387814  # the constant basis function: 1 / (2 sqrt(pi))
MAX_SH_DEGREE = 3
BACKGROUND = (0.0, 0.0, 0.0)  # RGB
