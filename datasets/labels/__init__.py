"""Pictures with labelled boxes, written for and read from labelling tools."""
