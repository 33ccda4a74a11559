"""Open, summarise, convert and seal recorded drives."""
