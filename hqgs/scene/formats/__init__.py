"""Readers and writers of the formats in which scenes are stored."""
