"""Decode ROS 1 and ROS 2 messages: their definitions, and parsing of their bytes."""
