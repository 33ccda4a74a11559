"""Analyze the clocks of a log: order, offsets, drift and faults."""
