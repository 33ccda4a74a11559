"""Ground truth: its file format, trajectories, annotations of other tools."""
