"""Search for readable records after damaged bytes of an MCAP file."""
