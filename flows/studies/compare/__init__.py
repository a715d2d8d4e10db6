"""Which of several models explains a test best, and what would decide between them."""
