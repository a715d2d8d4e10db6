"""Reduction and expansion."""
