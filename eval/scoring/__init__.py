"""Scores of a run against ground truth."""
