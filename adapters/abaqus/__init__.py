"""Decks with parts and instances, as Abaqus/CAE writes them, for CalculiX."""
