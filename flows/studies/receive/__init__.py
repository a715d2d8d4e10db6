"""Tests that arrive in a folder of the lab: identified, tracked, and updated with."""
