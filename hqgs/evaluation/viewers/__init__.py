"""Whether a viewer shows a scene right, and what is wrong where it does not."""
