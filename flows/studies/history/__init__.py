"""The history of a structure: its runs in a table, trends, and what changed between two."""
