"""From a log's blocks to the few signals that estimators take, by role."""
