"""The study of random layouts, with and without intersections: fitted on some, tested on others."""
