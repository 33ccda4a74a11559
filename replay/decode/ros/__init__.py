"""ROS 1 and ROS 2 messages: their definitions, and the walk through their bytes."""
