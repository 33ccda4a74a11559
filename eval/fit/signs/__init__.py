"""Fitting of the sign detector's threshold to labelled pictures and drives."""
