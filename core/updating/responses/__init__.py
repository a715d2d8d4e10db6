"""Kinds of responses that a model is compared with its test by, one a file."""
