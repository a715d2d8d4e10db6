"""Two models, two tests, or one of each, side by side."""
