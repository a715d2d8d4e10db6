"""Bayesian sampling: what test and prior knowledge together leave of the parameters."""
