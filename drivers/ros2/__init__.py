"""Robots that ros2_control drives, over DDS or rmw_zenoh, without ROS."""
