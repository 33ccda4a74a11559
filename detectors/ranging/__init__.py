"""From a detection's size to its range."""
