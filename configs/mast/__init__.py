"""A mast on soft mounts: frequencies, a pull at the head and a weighing in one campaign."""
