"""Draft of a vehicle file from a log: chosen signals, each with the reason for the choice."""
