"""Seals: block checksums for logs whose format has none."""
