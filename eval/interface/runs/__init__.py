"""Runs: made from drives one or many, estimated again, scored, compared, merged."""
