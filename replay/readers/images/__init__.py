"""Image folders and video."""
