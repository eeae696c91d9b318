"""Constants for the conversion of units."""

NANOSECONDS = 1_000_000_000
"""Nanoseconds per second."""
