"""Mobileye 560 over CAN: our own table as data, decoding and encoding in columns."""
