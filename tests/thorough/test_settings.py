import math
from collections.abc import Callable

import numpy as np
import pytest

import solvers
from pgo_models import grid, partition
from pgo_models.errors import SettingError
from solvers.baselines.gauss_seidel import GaussSeidel
from solvers.carry.ray_engine import RayEngine
from solvers.convex.bregman import AlternatingBregman, Bregman, TwoLineBregman
from solvers.convex.orthogonal import OrthogonalSOC
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.soc.anderson import Anderson
from solvers.soc.penalty import BalancedPenalty, BoydPenalty, FixedPenalty, MultiplierPenalty
from solvers.studies.benchmark import BenchmarkSettings
from solvers.studies.paper_tables import ReproductionSettings

OF_A_LOOP = {"tolerance": (0.0, -1.0, math.nan), "max_iterations": (-1,)}
OF_BREGMAN = {**OF_A_LOOP, "alpha": (0.0, -1.0, math.nan), "subproblem_tolerance": (math.inf,)}
# Values that a setting cannot have, by the class and the name of the setting.
WRONG: dict[Callable[..., object], dict[str, tuple[object, ...]]] = {
    solvers.SOC: {
        **OF_A_LOOP,
        "alpha": (0.0, 2.0, 2.5, math.nan),
        "local_passes": (0,),
        "bytes_per_number": (4,),
        "translation_penalty": (0.0,),
    },
    solvers.Newton: OF_A_LOOP,
    solvers.Staircase: {"gap": (0.0,)},
    solvers.GNC: {
        "quantile": (1.0,),
        "growth": (1.0,),
        "spread": (0.0,),
        "scale": (-1.0,),
        "inner_steps": (0,),
    },
    GaussSeidel: {"alpha": (0.0, 2.0), "gauss_newton_steps": (0,), "tolerance": (0.0,)},
    Bregman: OF_BREGMAN,
    TwoLineBregman: OF_BREGMAN,
    AlternatingBregman: OF_BREGMAN,
    OrthogonalSOC: {
        **OF_A_LOOP,
        "penalty": (0.0, math.nan),
        "alpha": (2.0,),
        "safeguard": (1.0,),
    },
    ComplexRelaxation: {"columns": (0,), "tolerance": (0.0,), "max_iterations": (-1,)},
    HullLagrangian: {"tolerance": (0.0,), "gap": (-1.0,), "rank": (3, 15)},
    Anderson: {"memory": (0,), "restart_ratio": (1.0, math.nan)},
    MultiplierPenalty: {
        "factor": (0.0, math.nan),
        "quantile": (-0.1, 1.1),
        "stall_window": (0,),
        "stall_ratio": (0.0, 1.0),
        "max_refreshes": (-1,),
    },
    FixedPenalty: {"rho": (0.0, -1.0, math.nan)},
    BalancedPenalty: {"scale": (0.0,)},
    BoydPenalty: {"scale": (0.0,)},
    RayEngine: {"num_cpus": (0,), "actors": (0,), "patience": (0.0,)},
    BenchmarkSettings: {"num_robots": (0,), "max_rounds": (1,), "time_limit": (0.0,)},
    ReproductionSettings: {"only": (("torus",),), "num_seeds": (0,), "num_robots": (0,)},
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_setting_out_of_its_range_is_refused_by_name(kind: Callable[..., object]) -> None:
    for name, values in WRONG[kind].items():
        for value in values:
            words = "torus" if name == "only" else name
            with pytest.raises(SettingError, match=words) as caught:
                kind(**{name: value})
            assert isinstance(caught.value, ValueError)


def test_joint_soc_has_one_robot() -> None:
    robots = partition(grid(np.random.default_rng(0)), 2)
    with pytest.raises(SettingError, match="JOINT has one robot"):
        solvers.SOC(coupling=solvers.Coupling.JOINT, robots=robots)
