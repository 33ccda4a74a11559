"""Landmark databases and how well images match."""
