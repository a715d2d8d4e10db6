"""A campaign file for a deck that has none yet."""
