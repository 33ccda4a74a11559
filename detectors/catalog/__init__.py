"""Model cards: what a network needs as input and what its output means."""
