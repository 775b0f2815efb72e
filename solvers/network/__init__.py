"""Where workers run and what crosses between them; no mathematics."""
