"""Pictures as arrays: pixels, files, degradations and the operators that imitate them."""
