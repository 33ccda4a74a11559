"""Block checksums beside logs whose format has none."""
