"""``crosscue truth ...``."""
