"""Divide a drive into time segments at set-backs of the clock and gaps of odometry."""
