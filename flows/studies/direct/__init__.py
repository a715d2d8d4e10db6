"""Whole matrices corrected from measured modes."""
