"""ROS 2 nodes: thin shells that convert, call the core, and publish."""
