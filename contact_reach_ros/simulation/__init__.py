"""The simulated robot: MuJoCo with contact, sensors, friction and brakes."""
