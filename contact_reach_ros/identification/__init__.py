"""From recorded motion to tool, joint friction, torque offsets, and what thresholds they permit."""
