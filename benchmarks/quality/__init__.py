"""Held-out quality of the methods on degraded photos."""
