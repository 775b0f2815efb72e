"""Measurements: pose graphs, their files, data sets and scenes, and which robot owns which pose."""
