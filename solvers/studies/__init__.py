"""Benchmarks, the paper's tables and figures, and studies of noise and error forgetting."""
