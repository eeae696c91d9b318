"""The browser viewer: a page that shows the arm, live or from a bag, and takes goals and stops (no ROS)."""
