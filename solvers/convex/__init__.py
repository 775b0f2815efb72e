"""The same splittings for any cvxpy problem."""
