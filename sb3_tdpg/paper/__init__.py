"""Reproduce the tables of the paper; only the command line imports this package."""
