"""Decks in the cards that MYSTRAN gets right."""
