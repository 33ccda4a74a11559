"""Pose errors, their consistency, and the batch smoother."""
