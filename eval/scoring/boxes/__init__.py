"""Detections against labelled boxes: matching, precision and recall, calibration."""
