"""Sliding-window ORB detection of one-way and do-not-enter signs."""
