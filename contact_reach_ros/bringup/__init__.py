"""Starts, supervises and ends the processes of the stack."""
