"""Compass and odometry fitted to known positions."""
