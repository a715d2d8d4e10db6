"""The scatter of parameters behind the scatter of repeated tests."""
