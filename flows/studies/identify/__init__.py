"""Modes from measured response functions."""
