"""Monte Carlo studies of navigation in towns (chapter 2)."""
