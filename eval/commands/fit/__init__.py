"""``crosscue fit ...``: fit sensors, detectors and beliefs to drives."""
