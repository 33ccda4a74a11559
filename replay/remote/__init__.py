"""Logs in an object store or behind HTTP."""
