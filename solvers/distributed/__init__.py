"""Methods by many robots, with a driver or without."""
