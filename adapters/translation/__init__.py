"""Nastran bulk data as a CalculiX deck, so that a Nastran model runs where there is no Nastran."""
