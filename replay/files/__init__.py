"""Read files with bounds, write them atomically, and compute checksums."""
