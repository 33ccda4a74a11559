"""Simulated intersections with pictures: plans, actors, a renderer, sensors and truth."""
