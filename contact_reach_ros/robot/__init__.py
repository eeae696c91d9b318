"""The KUKA iiwa 14: one table, and the MJCF, URDF and Pinocchio model made from it."""
