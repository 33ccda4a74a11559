"""Reader of MCAP recordings."""
