"""What the nodes need of ROS: lifecycle, parameters, quality of service, discovery, scheduling."""
