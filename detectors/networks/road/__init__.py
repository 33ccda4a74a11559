"""The embedded road segmentation network."""
