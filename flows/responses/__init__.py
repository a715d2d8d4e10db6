"""Responses that a campaign compares, one type a file: its keys and its requests to the solver."""
