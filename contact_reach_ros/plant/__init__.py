"""The simulated robot, its sensors and faults."""
