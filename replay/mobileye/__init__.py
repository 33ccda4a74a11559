"""Decode and encode Mobileye 560 data on CAN in columns, from a table of its signals."""
