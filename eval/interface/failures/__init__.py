"""Failures of runs: found, browsed, exported for labelling."""
