"""Readers of log formats; ``crosscue.replay.formats.FORMATS`` is the table of all formats."""
