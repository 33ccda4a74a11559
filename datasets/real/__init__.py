"""Published real drives: their sources, vehicle files and truth.

The recordings belong to others and are not in this repository. The vehicle files and annotations
are part of crosscue.
"""
