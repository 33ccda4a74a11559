"""Decode CAN payloads into columns of signals, by the bit layouts of a CAN database."""
