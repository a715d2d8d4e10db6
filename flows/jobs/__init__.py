"""Jobs: keys, the engine, limits, clusters."""
