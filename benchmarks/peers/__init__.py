"""Planners of other projects beside this package's, in one run; they live in an environment of their own."""
