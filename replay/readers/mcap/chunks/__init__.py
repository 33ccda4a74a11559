"""Chunks of an MCAP file: index, decompression, and columns of their messages."""
