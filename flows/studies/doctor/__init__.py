"""What is installed, and whether each solver does here what campaigns rely on."""
