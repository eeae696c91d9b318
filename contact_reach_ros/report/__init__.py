"""What bags amount to: numbers, plots and a page for browsers."""
