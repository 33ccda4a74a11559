"""``crosscue study ...``."""
