"""The published experiment on simulated intersections."""
