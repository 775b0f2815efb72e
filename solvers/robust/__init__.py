"""Robust estimation: wrong measurements among right ones."""
