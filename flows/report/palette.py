"""Colours of curves, those of Okabe and Ito (2008), told apart by everyone."""

from __future__ import annotations

TEST, BEFORE, AFTER = "#000000", "#56B4E9", "#D55E00"
PARAMETER_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
