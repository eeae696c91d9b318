"""Bags: writing and reading mcap recordings, and their signals, without a ROS installation."""
