"""The arm: its kinematics and dynamics, and the MJCF, URDF and Pinocchio model made from its table."""
