"""Splitting of orthogonality constraints: the paper's recursion and its parts."""
