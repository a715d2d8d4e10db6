"""A function of Python in the place of a solver: modes or matrices at parameter values."""
