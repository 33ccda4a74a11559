"""Reader of ROS 1 bags."""
