"""Pictures of the arm and its obstacles."""
