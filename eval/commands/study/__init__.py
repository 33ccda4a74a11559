"""``crosscue study ...``: simulated studies."""
