"""Cues of cars that are tracked over frames."""
