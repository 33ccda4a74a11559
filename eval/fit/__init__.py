"""Fitting of parameters to annotated drives."""
