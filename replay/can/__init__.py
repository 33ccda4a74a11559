"""CAN payloads to signal columns, by the bit layouts of a DBC file."""
