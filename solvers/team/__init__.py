"""Robots that are apart: an object for each, which exchanges messages and knows no network."""
