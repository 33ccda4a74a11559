"""Fitting of height-to-range curves: training pairs and a figure."""
