"""Building landmark databases and fitting the match threshold."""
