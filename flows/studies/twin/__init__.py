"""One model on several solvers."""
