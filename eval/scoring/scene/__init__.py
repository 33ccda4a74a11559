"""What is scored of a scene: cues, ranges, beliefs, and the approaches as a whole."""
