"""Real drives that crosscue knows: where they are published, their vehicle files and truth.

The recordings are others' and are never in this repository; vehicle files and annotations are ours.
"""
