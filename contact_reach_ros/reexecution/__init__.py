"""Re-execution of the nodes of a bag."""
