"""Updating by the solver's stored matrices: parts of parameters, modes, reduced steps."""
