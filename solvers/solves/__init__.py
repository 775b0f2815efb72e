"""Solves of other kinds: with terms of one's own, of files that robots keep, and of given poses."""
