"""Threshold of the sign detector: drives, labels, scores."""
