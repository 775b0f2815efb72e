"""cvxpy models: the R-subproblem, orthogonality constraints, and Bregman iteration."""
