"""Methods side by side, the paper's tables, and a study of noise."""
