"""The scene part of the estimate stage: cues, ranges and beliefs from stored detections."""
