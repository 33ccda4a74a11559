"""The Monte Carlo studies of chapter 2."""
