"""Scenes and degradations whose truth is known: the room photographed as life does it, photos made bad."""

from benchmarks.scenes import kinds as kinds  # it adds its kinds to those of hqgs
