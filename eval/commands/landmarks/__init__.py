"""``crosscue landmarks ...``."""
