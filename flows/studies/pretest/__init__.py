"""Where sensors and exciters go, from the model alone."""
