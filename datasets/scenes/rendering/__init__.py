"""The renderer of simulated scenes: meshes, textures, light, ground, weather."""
