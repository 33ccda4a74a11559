"""Fit of message models to annotated approaches."""
