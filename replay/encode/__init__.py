"""Encode blocks of any log as ROS 2 messages, the inverse of ``crosscue.replay.decode``."""
