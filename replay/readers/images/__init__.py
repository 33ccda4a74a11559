"""Readers of image folders and video files."""
