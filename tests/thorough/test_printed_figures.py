"""What is printed of a solve holds of the exact cost of its poses, in 300 bits: in words, in pages
and in tables.
"""

import csv
import io
import json
import re
from decimal import Decimal
from fractions import Fraction

import pytest
from exact_arithmetic import ExactGraph
from graphs import exact_graph, varied_graph
from pages import Page

import pgo_models as pgo
import solvers
from solvers import BenchmarkMethod, ComparisonSettings, compare_methods
from solvers.report.report import report_page

GRAPHS = {
    **{name: pgo.load(name) for name in ("sphere", "circle", "grid", "robots")},
    **{f"varied {seed}": varied_graph(seed, 9, 2 + seed % 2) for seed in range(6)},
    "without noise": exact_graph(0, 8, 3),
}
NUMBER = r"(-?\d+(?:\.\d+)?(?:e[-+]\d+)?)"


@pytest.fixture(scope="module", params=GRAPHS, ids=lambda name: name.replace(" ", "-"))
def solution(request):
    return solvers.solve(GRAPHS[request.param])


def exact_cost(solution: solvers.Solution, poses: pgo.Poses) -> Fraction:
    """F of poses without rounding, rounded up from 300 bits to 200."""
    value = ExactGraph.of_doubles(solution.problem.graph).objective_of(poses)
    return Fraction(int(value * 2**600) + 1, 2**600)


def figure(text: str, label: str) -> Fraction:
    """Number behind a label at the beginning of a line."""
    return Fraction(re.search(rf"^ *{label} +{NUMBER}", text, re.M)[1])


def check(text: str, cost: Fraction, lower_bound: float) -> None:
    """Hold the rows F, lower bound and gap of a text against the exact cost and bound."""
    assert figure(text, "lower bound") <= Fraction(lower_bound)
    assert figure(text, "F") >= cost
    if "gap          0: every edge fits to its rounding" in text:
        return
    gap = 1 - Fraction(lower_bound) / cost
    assert figure(text, "gap") >= gap
    digits = re.search(r"proven to (\d+) digits", text)
    assert digits is None or gap <= Fraction(1, 10 ** int(digits[1]))


def test_the_summary_of_a_solution(solution) -> None:
    cost = exact_cost(solution, solution.poses)
    check(str(solution), cost, solution.lower_bound)
    assert Fraction(re.search(rf"F={NUMBER}", repr(solution))[1]) >= cost


def test_a_certificate_of_other_poses(solution) -> None:
    before = solution.before()[0]
    certificate = solvers.certify(solution.problem, before)
    cost = exact_cost(solution, before)
    check(str(certificate), cost, certificate.lower_bound)
    assert Fraction(re.search(rf"F={NUMBER}", repr(certificate))[1]) >= cost


def test_a_report(solution) -> None:
    text = Page(report_page(solution)).text
    cost = exact_cost(solution, solution.poses)
    in_figures = re.search(rf"cost F\s*{NUMBER}", text)
    in_words = re.search(rf"The poses cost F = {NUMBER}", text)
    assert min(Fraction(in_figures[1]), Fraction(in_words[1])) >= cost
    bounds = [Fraction(found) for found in re.findall(rf"costs less than {NUMBER},", text)]
    bounds.append(Fraction(re.search(rf"lower bound\s*{NUMBER}", text)[1]))
    assert max(bounds) <= Fraction(solution.lower_bound)
    within = re.search(rf"to within {NUMBER} % of it", text)
    assert within is None or Fraction(within[1]) / 100 >= 1 - Fraction(solution.lower_bound) / cost


def test_figures_for_programs_are_the_doubles(solution) -> None:
    record = json.loads(json.dumps(solution.as_json()))
    assert record["objective"] == solution.objective
    assert record["lower_bound"] == solution.lower_bound
    assert record["gap"] == solution.gap
    assert record["objective"] + record["objective_error"] >= exact_cost(solution, solution.poses)


@pytest.mark.parametrize("name", ["grid", "circle", "varied 3", "without noise"])
def test_the_table_of_methods(name) -> None:
    chosen = BenchmarkMethod.NEWTON, BenchmarkMethod.JOINT
    compared = compare_methods(GRAPHS[name], ComparisonSettings(chosen))
    table = compared.table()
    graph = ExactGraph.of_doubles(compared.problem.graph)
    costs = [graph.objective_of(trial.poses) for trial in compared.trials]
    bound = Fraction(compared.lower_bound)
    for row, cost in zip(table.parts[0].rows, costs, strict=True):
        shown = Decimal(row[1])
        gap = Fraction(row[2]) / 100
        assert Fraction(shown) >= Fraction(int(cost * 2**600) + 1, 2**600)
        assert gap == 0 or gap >= 1 - bound / Fraction(int(cost * 2**600) + 1, 2**600)
    best, below = re.search(
        rf"best F {NUMBER}, proven lower bound {NUMBER};", table.notes[0]
    ).groups()
    assert Fraction(below) <= bound
    assert Fraction(best) >= min(Fraction(int(cost * 2**600), 2**600) for cost in costs)
    written = list(csv.DictReader(io.StringIO(table.csv())))
    assert [float(row["objective"]) for row in written] == [
        trial.objective for trial in compared.trials
    ]
