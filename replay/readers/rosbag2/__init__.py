"""Readers of ROS 2 bags: folders and sqlite3 files."""
