"""Joint torques from a reference: the paper's laws (1)-(3) and (6), torque limits, reference pairing."""
