"""The studies: of the town, of one drive in it, of intersections."""
