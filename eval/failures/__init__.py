"""Failures of runs: detection, ranking, grouping by cause, drawing, and export for labelling."""
