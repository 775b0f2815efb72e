"""Methods on the problems of `pgo_models`: every one is settings with init, step, measure and converged."""
