"""Rules that derive scene cues from detections."""
