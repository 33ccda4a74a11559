"""``crosscue fit ...``."""
