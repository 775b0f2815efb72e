"""Files with GPS in UTM coordinates: what is printed holds of the decimals of the file, exactly.

Cost and least cost are computed from the text, at 300 bits.
"""

from dataclasses import dataclass
from pathlib import Path

import mpmath
import numpy as np
import pytest

import pgo_models as pgo
import solvers

MP = mpmath.mp.clone()
MP.prec = 300
CASES = Path(__file__).parents[1] / "cases"
ODOMETRY = "10000 0 0 10000 0 10000"


def utm_file(seed: int) -> str:
    """A path of 3 to 6 poses a metre apart, with fixes and odometry of 1 cm, in millimetres."""
    rng = np.random.default_rng(seed)
    n = 3 + seed % 4
    heading = np.cumsum(rng.normal(0.0, 0.3, n))
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    t = np.array([689012.123, 5334876.877]) + np.cumsum(steps, axis=0)
    lines = []
    for i in range(n - 1):
        (c, s) = steps[i]
        x, y = [[c, s], [-s, c]] @ (t[i + 1] - t[i]) + rng.normal(0.0, 0.01, 2)
        turn = heading[i + 1] - heading[i] + rng.normal(0.0, 0.01)
        lines.append(f"EDGE_SE2 {i} {i + 1} {x:.3f} {y:.3f} {turn:.3f} {ODOMETRY}")
    for i, (x, y) in enumerate(t + rng.normal(0.0, 0.01, (n, 2))):
        lines.append(f"EDGE_PRIOR_SE2_XY {i} {x:.3f} {y:.3f} 10000 0 10000")
    return "\n".join(lines) + "\n"


@dataclass
class Expansion:
    """chi2 of the decimals of a file at x = (x_0, y_0, theta_0, x_1, ..), to second order."""

    value: mpmath.mpf
    gradient: mpmath.matrix
    hessian: mpmath.matrix

    def add(self, weight: mpmath.mpf, r: mpmath.mpf, slope: dict[int, mpmath.mpf]) -> None:
        """Add weight r^2 of a residual with these derivatives; its curvature is left to others."""
        self.value += weight * r * r
        for a, of_a in slope.items():
            self.gradient[a] += 2 * weight * of_a * r
            for b, of_b in slope.items():
                self.hessian[a, b] += 2 * weight * of_a * of_b


def expansion(text: str, x: list[mpmath.mpf]) -> Expansion:
    size = len(x)
    found = Expansion(MP.mpf(0), MP.zeros(size, 1), MP.zeros(size))
    for line in text.splitlines():
        tag, *words = line.split()
        numbers = [MP.mpf(word) for word in words]
        i = 3 * int(words[0])
        if tag == "EDGE_PRIOR_SE2_XY":
            for k in (0, 1):
                found.add(numbers[3], x[i + k] - numbers[1 + k], {i + k: MP.mpf(1)})
            continue
        j = 3 * int(words[1])
        a, b, turn, weight, of_turn = *numbers[2:6], numbers[10]
        c, s = MP.cos(x[i + 2]), MP.sin(x[i + 2])
        moved = c * a - s * b, s * a + c * b
        slopes = moved[1], -moved[0]
        for k in (0, 1):
            r = x[j + k] - x[i + k] - moved[k]
            found.add(weight, r, {i + k: MP.mpf(-1), j + k: MP.mpf(1), i + 2: slopes[k]})
            found.hessian[i + 2, i + 2] += 2 * weight * r * moved[k]
        angle = x[j + 2] - x[i + 2] - turn
        found.value += 2 * of_turn * (1 - MP.cos(angle))
        for row, sign in ((j + 2, 1), (i + 2, -1)):
            found.gradient[row] += 2 * of_turn * sign * MP.sin(angle)
            for column, other in ((j + 2, 1), (i + 2, -1)):
                found.hessian[row, column] += 2 * of_turn * sign * other * MP.cos(angle)
    return found


def least_cost(text: str, x: list[mpmath.mpf]) -> mpmath.mpf:
    """chi2 of the minimum beside x, to which Newton converges."""
    for _ in range(10):
        here = expansion(text, x)
        step = MP.lu_solve(here.hessian, -here.gradient)
        x = [a + b for a, b in zip(x, step, strict=True)]
        if max(map(abs, step)) < MP.mpf(2) ** -200:
            break
    return expansion(text, x).value


def assert_true_of_decimals(path: Path, folder: Path) -> None:
    text = path.read_text()
    problem = pgo.PGOProblem(pgo.read_g2o(path), weighting=pgo.Weighting.INFORMATION)
    solution = solvers.solve(problem, progress=False)
    certificate = solution.certificate
    x = []
    for i in problem.graph.bodies:
        t, R = solution.poses.t[i].tolist(), solution.poses.R[i].tolist()
        x += [MP.mpf(t[0]), MP.mpf(t[1]), MP.atan2(MP.mpf(R[1][0]), MP.mpf(R[0][0]))]
    cost = expansion(text, x).value
    least = least_cost(text, x)
    assert certificate.is_certified
    assert certificate.lower_bound <= least <= cost <= certificate.objective_at_most
    assert MP.mpf(certificate.bound_text) <= least
    assert MP.mpf(certificate.cost_text) >= cost
    assert abs(cost - certificate.objective) <= certificate.objective_error
    assert (cost - least) / cost <= certificate.proven_gap < 1e-10
    solution.save_proof(folder / "proof.json")
    assert pgo.verify_proof(path, folder / "proof.json").failure == ""


@pytest.mark.parametrize("seed", range(60))
def test_bound_cost_gap_and_proof_are_of_the_decimals_of_the_file(seed: int, tmp_path: Path):
    path = tmp_path / "utm.g2o"
    path.write_text(utm_file(seed))
    assert_true_of_decimals(path, tmp_path)


@pytest.mark.parametrize("name", ["utm_min", "utm_fail"])
def test_so_they_are_of_reported_files(name: str, tmp_path: Path):
    assert_true_of_decimals(CASES / f"{name}.g2o", tmp_path)
