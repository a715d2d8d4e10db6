"""The six-mass system of the reference thesis, chapter 3."""
