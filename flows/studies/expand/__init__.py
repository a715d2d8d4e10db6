"""Measured shapes on the whole mesh."""
