"""Simulated intersections with pictures: layouts, actors, a renderer, sensors and truth."""
