"""What bags amount to: signals, numbers, plots and a page for browsers."""
