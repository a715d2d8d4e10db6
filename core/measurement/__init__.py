"""Response functions, identification, sensors."""
