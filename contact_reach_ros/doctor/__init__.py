"""Checks before a run, `contact-reach doctor`: this machine, its software, and the stack that is running."""
