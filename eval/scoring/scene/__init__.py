"""Scores of cues, ranges, beliefs and approaches."""
