"""Test files, one module a format."""
