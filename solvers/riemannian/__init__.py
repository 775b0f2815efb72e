"""Methods on the manifold: the second stage, and the staircase."""
