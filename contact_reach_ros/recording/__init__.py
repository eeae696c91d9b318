"""Bags: writing, reading, replay and report."""
