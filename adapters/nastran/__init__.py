"""Nastran decks: their text, what their cards mean, and where parameters stand in them."""
