"""Bags: writing and reading mcap recordings without a ROS installation."""
