"""Extract the signals that estimators use from a log's blocks, by role."""
