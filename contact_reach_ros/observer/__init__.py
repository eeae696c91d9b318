"""External torques from a momentum observer, compared with the contact budget."""
