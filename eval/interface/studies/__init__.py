"""Functions that run the studies of the town, of single drives, of intersections and layouts."""
