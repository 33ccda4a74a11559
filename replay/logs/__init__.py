"""Logs opened, whatever their format, and parts and summaries of them."""
