"""Every public function and class answers what it is given: with a result, or in one sentence.

Each argument of each public name is replaced by ten wrong things in turn, beside right ones.
"""

import enum
import inspect
import io
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from public_results import RESULTS

import pgo_models as pgo
import solvers
from pgo_models.convex.graph_subproblem import Unknowns

WRONG: dict[str, Any] = {
    "None": None,
    "a word": "sphere",
    "a negative number": -1,
    "a fraction": 2.5,
    "nan": float("nan"),
    "an empty list": [],
    "a dict": {},
    "an object": object(),
    "a vector": np.zeros(3),
    "a class": pgo.Poses,
}
# Their work is whole studies, or a file of another process.
STUDIES = {"reproduce_tables", "compare_methods", "solve_folder"}
OTHERS = {"PGOError", "RayEngine"}


def scene() -> dict[str, Any]:
    """Right things by the name of the argument that takes them."""
    graph = pgo.grid_world(1, 8, 0)
    problem = pgo.PGOProblem(graph)
    solution = solvers.solve(graph)
    x = cp.Variable(2)
    J = cp.sum_squares(x - np.array([3.0, 4.0]))
    constrained = pgo.BregmanProblem(J, x, np.ones((1, 2)), np.ones(1))
    on_circle = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), unit_columns=[x])
    A, w = problem.residual_matrix
    return {
        **{name: getattr(graph, name) for name in ("num_poses", "i", "j", "R_ij", "t_ij")},
        **{name: getattr(graph, name) for name in ("kappa", "tau", "robot")},
        "graph": graph,
        "problem": problem,
        "poses": solution.poses,
        "estimate": solution.poses,
        "truth": graph.truth,
        "Lambda": solution.certificate.Lambda,
        "certificate": solution.certificate,
        "solution": solution,
        "path": "written.txt",
        "kitti": "written.kitti",
        "proof": "proof.json",
        "panels": [("solved", solution.poses)],
        "R": solution.poses.R,
        "t": solution.poses.t,
        "count": 2,
        "d": graph.d,
        "rng": 0,
        "num_robots": 2,
        "poses_per_robot": 5,
        "penalty": np.ones(problem.side),
        "rho": 1.0,
        "A": A,
        "w": w,
        "J": J,
        "variables": x,
        "K": np.ones((1, 2)),
        "f": np.ones(1),
        "unit_columns": [x],
        "method": solvers.Newton(),
        "name_or_path": "circle",
        "changer": lambda unknown: pgo.ModelChange(),
        "frames": [[{"x": [0.0], "y": [1.0]}]],
        "labels": ["start"],
        "iterates": [solution.poses],
        "methods": [solvers.Newton()],
        "factors": None,
        "constrained": constrained,
        "on_circle": on_circle,
    }


# Arguments that mean something else than elsewhere.
OF_THEIR_OWN: dict[str, dict[str, str]] = {
    "solve_orthogonal": {"problem": "on_circle"},
    "exp_map": {"w": "t"},
    "verify_proof": {"graph": "path"},
    "project_to_rotations": {"A": "R"},
    "read_kitti": {"path": "kitti"},
}
CLASSES_WITH_MORE: dict[str, dict[str, Any]] = {
    "Robot": {"name": "a", "team": ["a", "b"], "key": b"sixteen or more bytes"},
    "Partition": {"method": pgo.PartitionMethod.GIVEN},
    "noise_sweep": {
        "scene": solvers.SweptScene.GRID,
        "rotation_std": np.array([0.1]),
        "graphs": 1,
        "rng": 0,
    },
}


def checked_names() -> list[str]:
    names = []
    for package in (pgo, solvers):
        for name in package.__all__:
            public = getattr(package, name)
            is_protocol = getattr(public, "_is_protocol", False)
            is_enum = isinstance(public, type) and issubclass(public, enum.Enum)
            if not (is_protocol or is_enum or name in RESULTS | STUDIES | OTHERS):
                names.append(name)
    return names


def right_arguments(name: str, parameters: Any, things: dict[str, Any]) -> dict[str, Any]:
    """One right thing for every argument without a default."""
    own = OF_THEIR_OWN.get(name, {})
    right = {}
    for parameter in parameters.values():
        if parameter.default is parameter.empty:
            key = own.get(parameter.name, parameter.name)
            more = CLASSES_WITH_MORE.get(name, {})
            right[parameter.name] = more[parameter.name] if parameter.name in more else things[key]
    return right


@pytest.fixture(scope="module")
def things() -> dict[str, Any]:
    return scene()


@pytest.mark.parametrize("name", checked_names())
def test_a_wrong_thing_is_answered_in_one_sentence(name, things, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    pgo.write_tum(things["poses"], things["path"])
    things["solution"].save(things["kitti"])
    public = getattr(pgo, name, None) or getattr(solvers, name)
    parameters = inspect.signature(public).parameters
    right = right_arguments(name, parameters, things)
    plain = []
    for argument in parameters:
        for description, wrong in WRONG.items():
            call = f"{name}({argument}={description})"
            try:
                with redirect_stdout(io.StringIO()):
                    answer = public(**{**right, argument: wrong})
                    if inspect.isgenerator(answer):
                        next(answer)
            except pgo.PGOError as error:
                if "\n" in str(error) or len(str(error)) < 15:
                    plain.append(f"{call}: {error}")
            except Exception as error:
                plain.append(f"{call}: {type(error).__name__}: {error}")
    assert not plain, "\n".join(plain)


def test_every_public_function_is_a_door() -> None:
    for package in (pgo, solvers):
        public = {name: getattr(package, name) for name in package.__all__}
        functions = {name: value for name, value in public.items() if inspect.isfunction(value)}
        unchecked = {name for name in functions if not hasattr(functions[name], "__wrapped__")}
        assert unchecked <= {"verify_proof"}


ALIKE: dict[str, Callable[[dict[str, Any]], tuple[Any, Any]]] = {
    "a graph for a problem": lambda it: (
        pgo.certify_at(it["graph"], it["poses"]).gap,
        pgo.certify_at(it["problem"], it["poses"]).gap,
    ),
    "a problem for a graph, one number for all penalties": lambda it: (
        pgo.graph_qp(it["problem"], 12).qp.penalty.tolist(),
        pgo.graph_qp(it["graph"], np.full(8, 12.0)).qp.penalty.tolist(),
    ),
    "a list for an array": lambda it: (
        pgo.graph_qp(it["graph"], [12] * 8).qp.penalty.tolist(),
        pgo.graph_qp(it["graph"], np.full(8, 12.0)).qp.penalty.tolist(),
    ),
    "a member by its name": lambda it: (
        pgo.graph_qp(it["graph"], 12.0, unknowns="rotations").variables.unknowns,
        Unknowns.ROTATIONS,
    ),
    "a member of a setting by its name": lambda it: (
        solvers.SOC(r_step="clarabel"),
        solvers.SOC(r_step=solvers.RStep.CLARABEL),
    ),
    "a member with a hyphen": lambda it: (
        pgo.solve_relaxation(it["graph"], "hull-dual").form,
        pgo.RelaxationForm.HULL_DUAL,
    ),
    "a seed for a generator": lambda it: (
        pgo.grid(3).t_ij.tolist(),
        pgo.grid(np.random.default_rng(3)).t_ij.tolist(),
    ),
    "a solution for its poses": lambda it: (
        pgo.chi2(it["graph"], it["solution"]),
        pgo.chi2(it["graph"], it["poses"]),
    ),
    "a graph for a run": lambda it: (
        solvers.run(solvers.SOC(), it["graph"]).objective,
        solvers.run(solvers.SOC(), it["problem"]).objective,
    ),
    "the name of a solver in any case": lambda it: (
        solvers.solve_orthogonal(it["on_circle"], 0, starts=1, solver="clarabel").objectives,
        solvers.solve_orthogonal(it["on_circle"], 0, starts=1, solver="CLARABEL").objectives,
    ),
    "poses for one panel": lambda it: (
        len(pgo.compare_poses(it["graph"], it["poses"]).axes),
        len(pgo.compare_poses(it["graph"], [("", it["poses"])]).axes),
    ),
}


@pytest.mark.parametrize("meaning", ALIKE)
def test_what_is_clear_is_converted(meaning, things) -> None:
    given, meant = ALIKE[meaning](things)
    assert given == meant


REFUSED: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (
        lambda it: pgo.graph_qp(it["graph"], np.full(5, 12.0)),
        r"rho has shape \(5,\); give one number, or one for each of 8 poses",
    ),
    (
        lambda it: pgo.graph_qp(pgo.PGOProblem(it["graph"], weighting="rotations"), 12.0),
        "terms are added to F",
    ),
    (
        lambda it: pgo.graph_qp(it["graph"], 1.0, unknowns="pose"),
        r"got 'pose'; did you mean Unknowns\.POSES\?",
    ),
    (
        lambda it: solvers.run(solvers.Bregman(), it["on_circle"].problem),
        r"Bregman: problem must be a BregmanProblem, got Problem.*; BregmanProblem\(J",
    ),
    (
        lambda it: solvers.run(solvers.OrthogonalSOC(), it["on_circle"].problem),
        r"must be an OrthogonalProblem, got Problem.*; OrthogonalProblem\(problem, rot",
    ),
    (
        lambda it: solvers.run(solvers.SOC, it["problem"]),
        r"method must be a Method, got the class SOC; give an object, as SOC\(\.\.\)",
    ),
    (
        lambda it: solvers.run(it["problem"], solvers.SOC()),
        "method must be a Method, got PGOProblem.*; it has no `max_iterations`",
    ),
    (
        lambda it: solvers.run(solvers.SOC(), it["problem"], it["R"]),
        r"SOC: start must be Poses or None, got an array of shape \(8, 3, 3\)",
    ),
    (lambda it: pgo.PGOProblem("sphere"), r"graph must be a PoseGraph, got 'sphere'.*load\(\.\.\)"),
    (lambda it: pgo.PGOProblem(it["problem"]), "`.graph` of a problem is one"),
    (lambda it: it["solution"].marginals(3.0), "a pose is 3.0; give a whole number"),
    (lambda it: it["solution"].marginals([0, 1]), r"a pose is \[0, 1\]; give a whole number"),
    (
        lambda it: it["graph"].without_edges(it["graph"].kappa),
        "mask must be an array of booleans, got an array of shape",
    ),
    (lambda it: pgo.grid(-1), "the seed is -1; give a whole number that is not negative"),
    (lambda it: solvers.OrthogonalSOC(solver="MOSKE"), "solver 'MOSKE' is not installed; cvxpy"),
    (
        lambda it: solvers.extend(it["solution"], pgo.load("grid")),
        "grid has none of the measurements of grid_world, which was solved; give the whole graph",
    ),
    (
        lambda it: solvers.extend(it["solution"], pgo.victoria_park(0, num_poses=40)),
        "in 2 dimensions and grid_world, which was solved, in 3; solve it on its own",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_is_not_clear_is_named_with_the_way_out(call, message, things) -> None:
    with pytest.raises(pgo.PGOError, match=message):
        call(things)
