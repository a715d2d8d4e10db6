"""Updating: evaluation, sensitivities, the loop."""
