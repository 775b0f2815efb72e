"""Models of pose graph optimisation: graphs, the problem, convex models, starts, certificates.

Nothing here iterates; methods are in `solvers`.
"""

from pgo_models.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
