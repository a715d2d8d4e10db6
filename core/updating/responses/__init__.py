"""Types of responses by which a model is compared with its test, one per file."""
