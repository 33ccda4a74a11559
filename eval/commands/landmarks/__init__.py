"""``crosscue landmarks ...``: add, list and match landmarks of a database."""
