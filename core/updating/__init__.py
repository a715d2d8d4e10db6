"""Responses, sensitivities, parameter matrices, steps, trust."""
