"""``crosscue train ...``: render training pictures, and train the built-in networks."""
