"""Commands for networks: the model catalog, and model cards."""
