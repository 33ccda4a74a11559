"""Clocks of a log: their order, offsets and findings."""
