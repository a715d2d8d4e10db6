"""How jobs are carried out: the engine, and the places they run in."""
