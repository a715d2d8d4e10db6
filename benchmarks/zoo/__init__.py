"""Random structures of families that no campaign of this project was made on."""
