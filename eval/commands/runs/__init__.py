"""A run: made, estimated again, scored, compared, merged, viewed."""
