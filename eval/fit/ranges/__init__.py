"""Height-to-range curves: pairs and their figure."""
