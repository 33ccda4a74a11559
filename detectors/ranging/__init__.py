"""Estimation of the range of detected objects."""
