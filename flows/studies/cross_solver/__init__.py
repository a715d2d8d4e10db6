"""One model on several solvers, modes side by side."""
