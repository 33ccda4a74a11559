"""Find failures of runs, browse them, and export them for labelling."""
