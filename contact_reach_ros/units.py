"""Constants that turn one unit into another."""

NANOSECONDS = 1_000_000_000
"""Per second."""
