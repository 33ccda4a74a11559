"""Mask R-CNN: weights, graph, back ends."""
