"""Exchange pictures with labelled boxes with labelling tools."""
