"""Where an MCAP file goes on after damage."""
