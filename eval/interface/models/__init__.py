"""Networks and their cards."""
