"""ROS 1 and 2: bags."""
