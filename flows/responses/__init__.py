"""Responses that a campaign compares, one type per file: its keys and its requests to the
solver."""
