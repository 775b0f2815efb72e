"""The report of a solve: one page that opens offline."""
