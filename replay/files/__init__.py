"""Bounded reading, atomic writing, checksums."""
