"""Mobileye messages as ROS topics."""
