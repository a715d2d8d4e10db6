"""A model condensed to a few of its unknowns."""
