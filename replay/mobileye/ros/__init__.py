"""Read Mobileye messages from ROS topics."""
