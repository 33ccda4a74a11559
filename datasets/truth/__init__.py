"""Ground truth: its file format, trajectories, and annotations of other tools."""
