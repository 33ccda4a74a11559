"""Rules from detections to scene cues."""
