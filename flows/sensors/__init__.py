"""Where a test's sensors are on the model."""
