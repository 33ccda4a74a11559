"""Fitting of a detector's thresholds and calibrations to labelled boxes."""
