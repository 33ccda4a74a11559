"""Commands about what went wrong in runs."""
