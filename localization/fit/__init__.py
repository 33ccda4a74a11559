"""Fit of compass and odometry to known positions."""
