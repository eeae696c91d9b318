"""The simulated robot: MuJoCo with contact, sensors, friction, brakes and faults."""
