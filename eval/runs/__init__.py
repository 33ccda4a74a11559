"""A run on disk: its folder, tables and manifest."""
