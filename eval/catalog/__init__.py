"""Runs below a folder: finding, comparing, decoded logs."""
