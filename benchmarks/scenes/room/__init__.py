"""The room of the built-in scene, ray-cast: its photos and points, and more for the benchmarks."""
