"""Drives behind the adapter: how each takes torques, in which order, and what stops it."""
