"""The chunks of an MCAP file: found, decompressed, and their messages as columns."""
