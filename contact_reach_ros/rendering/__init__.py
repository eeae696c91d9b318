"""Pictures of the arm among its obstacles, without a display."""
