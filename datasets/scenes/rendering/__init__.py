"""Renderer of simulated scenes: meshes, textures, light, ground and weather."""
