"""The embedded solver: models that are matrices, or springs and masses in a few lines of YAML."""
