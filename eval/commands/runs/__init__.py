"""Commands that make, re-estimate, score, compare, merge and view runs."""
