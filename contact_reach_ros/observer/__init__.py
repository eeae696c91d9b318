"""External torques from a momentum observer, and what the contact budget makes of them."""
