"""Many structures on one page, worst first."""
