"""A drive as time segments: jumps of the clock and silent odometry."""
