"""The node in ROS 2."""
