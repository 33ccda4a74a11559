"""CAN payloads to signal columns, by the bit layouts that a DBC file gives."""
