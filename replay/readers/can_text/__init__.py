"""Readers of CAN logs in text form: candump, ASC and TRC."""
