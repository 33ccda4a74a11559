"""Blocks of any log to ROS 2 messages: the way back from ``crosscue.replay.decode``."""
