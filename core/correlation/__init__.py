"""How alike modes are, and which belong together."""
