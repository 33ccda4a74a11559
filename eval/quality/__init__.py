"""Is a log good enough? Verdicts on a drive, for each purpose, from a table of checks."""
