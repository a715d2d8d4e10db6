"""Universal files (UFF, UNV) of test systems, read and written through pyuff."""
