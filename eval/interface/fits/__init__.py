"""Fits of a vehicle file's values to drives."""
