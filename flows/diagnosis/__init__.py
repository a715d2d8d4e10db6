"""What is wrong with a test or a model that disagree: `modetune check`, and updates that fail."""
