"""A robust solve: attempts to find the wrong edges, the choice among them, revision and verdict."""
