"""The cost F with its matrices and derivatives, sparse Cholesky factorisation, and starts."""
