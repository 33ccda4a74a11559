"""Thresholds and calibrations of a detector, from labelled boxes."""
