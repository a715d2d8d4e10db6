"""Nastran decks: their text, the meaning of their cards, and the places of parameters."""
