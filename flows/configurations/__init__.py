"""Several configurations of one structure, updated at once."""
