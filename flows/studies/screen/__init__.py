"""Screening: which of many candidate parameters the test determines, and which to update."""
