"""A rail launcher: generator of its model in any size, its test, and three campaigns."""
