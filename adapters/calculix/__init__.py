"""CalculiX CrunchiX (ccx): decks in its Abaqus-like input language, results from its .dat file."""
