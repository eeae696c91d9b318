"""The solver of plans: its contract, Algorithm 1 and the distribution of its candidates."""
