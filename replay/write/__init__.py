"""Writing MCAP."""
