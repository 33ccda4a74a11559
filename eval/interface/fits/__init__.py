"""Fit sensors, detectors, ranges and beliefs to drives."""
