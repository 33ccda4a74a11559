"""The landmark database and its image matchers."""
