"""Screening: which of many candidate parameters the test can tell, and which to update."""
