"""Methods side by side, the paper's tables, and what a file means and how noisy it is."""
