"""Cameras, views and scenes, and everything that makes or changes one."""
