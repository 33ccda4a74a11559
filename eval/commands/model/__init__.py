"""Commands about networks: the catalog, and cards for one's own."""
