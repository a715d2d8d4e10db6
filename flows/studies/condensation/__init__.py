"""Reduction, expansion and direct methods on a model's own matrices."""
