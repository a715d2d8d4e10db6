"""Matrices, factorisations, eigenvalue problems."""
