"""Campaigns that run as they are, with their decks and test data or the generators of them."""
