"""Whether an answer holds on what was not used."""
