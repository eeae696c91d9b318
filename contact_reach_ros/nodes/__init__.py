"""ROS 2 lifecycle nodes: thin wrappers that only translate messages."""
