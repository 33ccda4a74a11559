"""Checks of a vehicle file against a log: camera mounting and agreement of signals."""
