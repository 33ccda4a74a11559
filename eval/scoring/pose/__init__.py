"""Pose errors, consistency and the batch smoother."""
