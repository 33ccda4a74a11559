"""Make, re-estimate, score, compare and merge runs of one or many drives."""
