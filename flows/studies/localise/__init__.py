"""Where the model is wrong, and whether its parameters can correct it."""
