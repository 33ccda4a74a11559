"""Cues of cars that are followed over frames."""
