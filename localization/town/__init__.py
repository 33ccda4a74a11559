"""Monte Carlo simulator: town, vehicle and drives."""
