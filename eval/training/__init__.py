"""Functions that render training pictures, and train and measure networks."""
