"""Simulated studies: navigation in towns (chapter 2), intersections (chapter 3), and layouts."""
