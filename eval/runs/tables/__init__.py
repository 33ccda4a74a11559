"""Writing and reading the tables of a run."""
