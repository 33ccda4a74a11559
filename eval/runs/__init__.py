"""Runs on disk: folder, tables, manifest and account."""
