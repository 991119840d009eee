"""Pipelines between recordings: what the commands do, without a command line and without ROS 2."""
