"""Networks and their model cards."""
