"""The campaign: its file, its settings, its model and its test, all checked."""
