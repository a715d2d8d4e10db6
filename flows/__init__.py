"""Campaigns: the file that describes one, the job engine, the updating loop, the command line."""
