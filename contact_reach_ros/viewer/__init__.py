"""The browser viewer: a page that shows the arm, live or from a bag, and passes on what a user wants (no ROS)."""
