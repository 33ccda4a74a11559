"""The Monte Carlo simulator: town, vehicle, drives."""
