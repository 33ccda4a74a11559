"""Readers of CAN logs in text form: candump, ASC, TRC and BUSMASTER."""
