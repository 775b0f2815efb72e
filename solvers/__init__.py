"""Solvers for the problems of `pgo_models`.

A solver is a settings object with the methods `init`, `step`, `measure` and `converged`.
"""

from pgo_models.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
