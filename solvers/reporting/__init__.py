"""A solution in words, tables and pictures."""
