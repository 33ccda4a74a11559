"""Write logs as MCAP files."""
