"""``crosscue train ...``."""
