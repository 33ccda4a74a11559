"""What went wrong in runs: found, ranked, grouped by cause, drawn, and exported for labelling."""
