"""The cases of the reference thesis, run from beginning to end."""
