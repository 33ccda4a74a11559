"""The stage that makes ranges, beliefs and cues of what was detected."""
