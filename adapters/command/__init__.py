"""Any program that a command line starts: a deck template, and results in a form that is read."""
