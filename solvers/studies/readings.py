"""Which reading of a g2o file is meant: its edges, solved as written and under other readings.

The right reading of consistent measurements leaves the residuals that their noise explains, and a
wrong one leaves inconsistent loops. So the costs at the optima tell readings apart, but only as far
as chance does not: see `ReadingFit`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgo_models.errors import FAILURES, FileFormatError, GraphWarning
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.datasets import load, locate
from pgo_models.graphs.g2o import g2o_files
from pgo_models.graphs.g2o_parser import read_lines
from pgo_models.graphs.g2o_readings import ROTATION_FIRST, Reading
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from pgo_models.summaries import Summarised
from solvers.pipeline import solve
from solvers.request import Pipeline
from solvers.riemannian.newton import Newton
from solvers.solution import Solution

# Factors by which lengths, or angles of less than a turn, are made smaller.
_SHRINKING = {
    Reading.CLOSURES_IN_MILLIMETRES: 1e-3,
    Reading.ODOMETRY_IN_MILLIMETRES: 1e-3,
    Reading.DEGREES: math.pi / 180.0,
}
# Parts of readings that are the same as another one, or change units alone, if they change all
# edges.
_OF_SOME_EDGES = (
    Reading.CLOSURES_REVERSED,
    Reading.ODOMETRY_REVERSED,
    Reading.CLOSURES_IN_MILLIMETRES,
    Reading.ODOMETRY_IN_MILLIMETRES,
)
# A reading is proposed from this evidence on, odds of 10,000 to one. It also has to be clearly
# better: its cost is smaller by the next factor. Where the weights are others, so that the costs
# cannot be compared, the cost is off by a factor of _LEAST_MISFIT from what is expected as written,
# and by _MOST_MISFIT at most as proposed. Many files claim a hundredth of the information that they
# have, and mean no square roots.
_LEAST_EVIDENCE = math.log(1e4)
_LEAST_RATIO = 10.0
_LEAST_MISFIT = {
    Reading.COVARIANCES: 30.0,
    Reading.SQUARE_ROOTS: 1000.0,
    Reading.TORO_ORDER: 1000.0,
    **dict.fromkeys(ROTATION_FIRST, 30.0),
}
# Orders of matrices may make the cost too large as well, by this factor at least.
_ORDERS = {Reading.TORO_ORDER, *ROTATION_FIRST}
_LEAST_EXCESS = 1000.0
_MOST_MISFIT = 10.0
_FAR_TOO_SMALL = 1.0 / 30.0  # times what is expected: then square roots are at least mentioned
_MOST_MISFIT_OF_BLOCKS = 2.0  # where blocks are exchanged, which changes the cost either way
_CLOSE = math.log(1e3)  # difference of evidence up to which a reading is named beside the best
_TURN = 2.0 * math.pi  # no program writes larger angles in radians
# There is nothing to gain from other starts or a better bound under a wrong reading.
_PLAIN = Pipeline(
    newton=Newton(max_iterations=30),
    growing=None,
    other_starts=False,
    staircase=None,
    handedness=None,
)
_QUESTIONS = {
    Reading.CLOSURES_REVERSED: "were they written from j to i?",
    Reading.ODOMETRY_REVERSED: "was it written from j to i?",
    Reading.REVERSED: "were they written from j to i?",
    Reading.W_FIRST: "were they written as w x y z?",
    Reading.DEGREES: "were they written in degrees?",
    Reading.TORO_ORDER: "were they written in this order?",
    Reading.ROTATION_FIRST: "were they written with the rotation first, as GTSAM has it?",
    Reading.COVARIANCES: "are they covariances?",
    Reading.SQUARE_ROOTS: "are they square roots?",
    Reading.CLOSURES_IN_MILLIMETRES: "were they written in millimetres?",
    Reading.ODOMETRY_IN_MILLIMETRES: "was it written in millimetres?",
}


@dataclass(frozen=True)
class ReadingFit(Summarised):
    """How well the measurements of a file fit each other under a reading."""

    reading: Reading
    num_changed: int  # how many edges of the graph it changes
    # least cost that was found, nan if the file cannot be read or solved like this
    cost: float = math.nan
    # the cost over its expectation, if errors have the covariances of the matrices; 0 if there is
    # no redundancy.
    times_expected: float = math.nan
    # Log-odds for this reading against the file as written, natural logarithm. Let c and c' be the
    # costs and f the degrees of freedom. For readings with the same weights it is f / 2 log(c /
    # c'), whatever the scale of the noise. Where lengths or angles are made smaller, c' is divided
    # by the square of the factor first, as noise becomes smaller, too. Readings of the matrices
    # have other weights: with x and x' the costs over their expectations, it is f / 2 (h(x) -
    # h(x')), h(x) = x - 1 - log x, by which the likelihoods of the scale 1 differ.
    evidence: float = -math.inf

    @property
    def text(self) -> str:
        """The reading in words, with the number of edges if it is about some of them."""
        words = self.reading.text
        closures = "closure" if self.num_changed == 1 else "closures"
        return words.replace("the closures", f"the {self.num_changed} {closures}")

    @property
    def question(self) -> str:
        """What to ask whoever wrote the file."""
        question = _QUESTIONS.get(self.reading, "were they written so?")
        return question.replace("were they", "was it") if self.num_changed == 1 else question


@dataclass(frozen=True)
class ReadingComparison(Summarised):
    """The readings of a file, and which of them fits it better than what is written."""

    cost_name: str  # name of the cost: chi2, or F where the file has no chi2
    written: ReadingFit  # the file as written
    others: tuple[ReadingFit, ...]  # the file under the other readings that change it
    # Those that fit better beyond chance, the best first. It is empty for files that mean what they
    # say, and where nothing can be told.
    proposed: tuple[ReadingFit, ...]
    invalid: str = ""  # why the file cannot be read as written; "" where it can
    is_misfit: bool = False  # whether the edges as written cost more together than chance allows

    def sentence(self) -> str:
        """Return the costs as written and as proposed, and the question that they raise."""
        written = _with_share(self.written)
        invalid = f"As written the file is invalid: {self.invalid}." if self.invalid else ""
        if not self.proposed and invalid:
            return f"{invalid} No other reading fits."
        if not self.proposed:
            return f"{self.cost_name} {written}: {self._no_other_reading()}"
        best, *others = self.proposed
        begin = f"{invalid} {self.cost_name} " if invalid else f"{self.cost_name} {written}, "
        text = f"{begin}{_with_share(best)}: {best.question}"
        if others:
            text += f" Nearly as likely: {' or '.join(fit.text for fit in others)}."
        return text

    def _no_other_reading(self) -> str:
        """What is said where no reading is proposed, though square roots may explain the cost."""
        for fit in self.others:
            is_likely = fit.reading is Reading.SQUARE_ROOTS and fit.evidence >= _LEAST_EVIDENCE
            if is_likely and self.written.times_expected <= _FAR_TOO_SMALL <= fit.times_expected:
                return f"the matrices claim too little, or are square roots: {_with_share(fit)}."
        return "no other reading fits better beyond chance."

    def __str__(self) -> str:
        fits = (self.written, *self.others)
        width = max(26, *(len(fit.reading.value) for fit in fits))
        lines = [f"{'reading':<{width}}{self.cost_name:>12}{'times expected':>16}"]
        for fit in fits:
            times = f"{fit.times_expected:.3g}" if fit.times_expected else "-"
            lines.append(f"{fit.reading.value:<{width}}{fit.cost:>12.4g}{times:>16}")
        return "\n".join(lines)


def compare_readings(
    name_or_path: str | Path,
    *,
    unit_weights: bool = False,
    skip_unknown: bool = False,
    trust_folder: bool = False,
) -> ReadingComparison:
    """Solve a g2o file as written and under every other `Reading`, and compare the costs.

    Each reading is solved once, by Newton's method from its usual start. Where none of them fits
    better and the cost is far off, pairs of readings are tried. Nothing is claimed of a file whose
    edges all fit as closely as its numbers can tell, and nothing that chance could explain. Of a
    graph in parts the largest component is compared.

    Arguments are as for `load`; a JSON robot log leaves no choice. Raises the errors of `load` and
    `solve` when the file can neither be read as written nor otherwise.

    Examples
    --------
    >>> comparison = compare_readings("grid")
    >>> comparison.written.reading.text, comparison.proposed
    ('as written', ())
    """

    def read(reading: Reading) -> PoseGraph:
        graph = load(
            name_or_path,
            reading=reading,
            unit_weights=unit_weights,
            skip_unknown=skip_unknown,
            trust_folder=trust_folder,
        )
        largest, *others = graph.parts()
        if not others:
            return graph
        text = f"{graph.name} has {len(others) + 1} components, of which the largest is compared"
        warnings.warn(text, GraphWarning, stacklevel=3)
        return graph.subgraph(largest)

    try:
        graph = read(Reading.AS_WRITTEN)
    except FileFormatError as error:
        return _readings_of_invalid(error, read)
    problem, solution, residuals = _solved(graph)
    written = ReadingFit(Reading.AS_WRITTEN, 0, solution.objective, residuals.overall, 0.0)
    has_large_angles = _has_large_angles(name_or_path, graph.d)
    trial = _Trial(graph, written, residuals.freedom, read, has_large_angles)
    with warnings.catch_warnings(action="ignore"):  # of the reader, once more
        others = trial.fits([reading for reading in Reading if not reading.is_pair])
        proposed = _proposed(others, written)
        best = proposed[0] if proposed else written
        if _may_be_pair(best):
            pairs = trial.fits([reading for reading in Reading if reading.is_pair])
            turned = [fit for fit in pairs if _needs_reversal(fit, others, written)]
            others += pairs
            proposed = _proposed(tuple(turned), best) or proposed
    is_misfit = residuals.is_overall_misfit
    return ReadingComparison(problem.cost_name, written, others, proposed, is_misfit=is_misfit)


def _may_be_pair(best: ReadingFit) -> bool:
    """Whether the cost of the best fit is so far from what is expected that more may be wrong."""
    is_too_small = best.times_expected <= 1.0 / _LEAST_MISFIT[Reading.ROTATION_FIRST]
    return is_too_small or best.times_expected >= _LEAST_EXCESS


def _needs_reversal(pair: ReadingFit, others: tuple[ReadingFit, ...], written: ReadingFit) -> bool:
    """Whether reversed edges fit clearly better than the same matrices with edges as written.

    Of edges that fit exactly as written only the matrices could be others.
    """
    if pair.reading not in ROTATION_FIRST:
        return True
    alone = [fit for fit in others if fit.reading is Reading.ROTATION_FIRST]
    same_matrices = alone[0] if alone else written
    return not pair.cost * _LEAST_RATIO > same_matrices.cost


def _readings_of_invalid(
    error: FileFormatError, read: Callable[[Reading], PoseGraph]
) -> ReadingComparison:
    """Readings that make sense of a file which has none as written; the error where none does.

    Proposed are those of which the cost is what their matrices make expected, or nearly so.
    """
    with warnings.catch_warnings(action="ignore"):
        fits, cost_name = _fits_of_readable(read, are_pairs=False)
        proposed = _as_expected(fits)
        if not proposed:
            pairs, cost_of_pairs = _fits_of_readable(read, are_pairs=True)
            fits += pairs
            cost_name = cost_of_pairs or cost_name
            proposed = _as_expected(pairs)
    if not fits:
        raise error
    written = ReadingFit(Reading.AS_WRITTEN, 0)
    invalid = error.problem.partition(";")[0]
    return ReadingComparison(cost_name, written, tuple(fits), proposed, invalid)


def _fits_of_readable(
    read: Callable[[Reading], PoseGraph], are_pairs: bool
) -> tuple[list[ReadingFit], str]:
    """Fits under all readings, or pairs of them, that make a graph, and the name of their cost."""
    fits = []
    cost_name = ""
    for reading in Reading:
        if reading.is_pair is not are_pairs:
            continue
        try:
            problem, solution, residuals = _solved(read(reading))
        except (FileFormatError, *FAILURES):
            continue
        cost_name = problem.cost_name
        num_edges = problem.graph.num_edges
        fits.append(ReadingFit(reading, num_edges, solution.objective, residuals.overall))
    return fits, cost_name


def _solved(graph: PoseGraph) -> tuple[PGOProblem, Solution, EdgeResiduals]:
    """A graph solved for its own cost by Newton's method alone, and how well its edges fit."""
    problem = PGOProblem(graph)
    solution = solve(problem, _PLAIN)
    return problem, solution, edge_residuals(problem, solution.all_poses)


def _as_expected(fits: list[ReadingFit]) -> tuple[ReadingFit, ...]:
    """Fits whose cost is about what their matrices make expected, the best first."""
    close = [fit for fit in fits if _log_misfit(fit) <= math.log(_MOST_MISFIT)]
    return tuple(sorted(close, key=_log_misfit))


def _log_misfit(fit: ReadingFit) -> float:
    """How far the cost is from what is expected, on the scale of logarithms."""
    return abs(math.log(fit.times_expected)) if fit.times_expected > 0.0 else math.inf


@dataclass(frozen=True)
class _Trial:
    """A graph as written, and what is needed to solve it under another reading."""

    graph: PoseGraph
    written: ReadingFit
    freedom: float
    read: Callable[[Reading], PoseGraph]
    has_large_angles: bool

    def fits(self, readings: list[Reading]) -> tuple[ReadingFit, ...]:
        """Fits under those readings that are for this file and change something."""
        fits = [self.fit(reading) for reading in readings if reading is not Reading.AS_WRITTEN]
        return tuple(fit for fit in fits if fit is not None)

    def fit(self, reading: Reading) -> ReadingFit | None:
        """The fit under a reading; None if it is not for this file, or changes nothing."""
        if reading.dimension not in (None, self.graph.d):
            return None
        try:
            graph = self.read(reading)
        except FileFormatError:  # as of covariances that are not definite
            return None
        changed = _changed_edges(graph, self.graph)
        num_changed = int(changed.sum())
        if num_changed == 0 or (changed.all() and reading.parts[0] in _OF_SOME_EDGES):
            return None
        try:
            _, solution, residuals = _solved(graph)
        except FAILURES:  # of linear algebra, with numbers that mean nothing
            return ReadingFit(reading, num_changed)
        overall = residuals.overall
        evidence = self._evidence(reading, solution.objective, overall)
        return ReadingFit(reading, num_changed, solution.objective, overall, evidence)

    def _evidence(self, reading: Reading, cost: float, times_expected: float) -> float:
        """Log-odds, see `ReadingFit`."""
        half_freedom = 0.5 * self.freedom
        if not (cost > 0 and times_expected > 0 and self.written.cost > 0):
            return -math.inf
        if reading in _LEAST_MISFIT:
            misfit = _misfit(self.written.times_expected) - _misfit(times_expected)
            return half_freedom * misfit
        return half_freedom * math.log(self.written.cost / self._comparable(reading, cost))

    def _comparable(self, reading: Reading, cost: float) -> float:
        """A cost as it were if lengths or angles had not been made smaller."""
        if reading is Reading.DEGREES and self.has_large_angles:
            return cost
        return cost / _SHRINKING.get(reading, 1.0) ** 2


def _misfit(times_expected: float) -> float:
    """h(x) = x - 1 - log x, zero where the cost is what is expected."""
    return times_expected - 1.0 - math.log(times_expected)


def _proposed(fits: tuple[ReadingFit, ...], written: ReadingFit) -> tuple[ReadingFit, ...]:
    """Readings that fit better beyond chance, and nearly as well as the best of them."""
    better = [fit for fit in fits if fit.evidence >= _LEAST_EVIDENCE and _is_clear(fit, written)]
    better.sort(key=lambda fit: -fit.evidence)
    return tuple(fit for fit in better if fit.evidence >= better[0].evidence - _CLOSE)


def _is_clear(fit: ReadingFit, written: ReadingFit) -> bool:
    """Whether a reading fits not only beyond chance, but clearly better."""
    if fit.reading not in _LEAST_MISFIT:
        return fit.cost * _LEAST_RATIO <= written.cost
    most_misfit = _MOST_MISFIT_OF_BLOCKS if fit.reading in ROTATION_FIRST else _MOST_MISFIT
    if not 1.0 / most_misfit <= fit.times_expected <= most_misfit:
        return False
    # Covariances and square roots of less than one make the cost too small. One that is too large
    # is more often that of a wrong edge, which larger covariances would only hide.
    least_misfit = _LEAST_MISFIT[fit.reading]
    is_too_small = written.times_expected <= 1.0 / least_misfit
    is_too_large = written.times_expected >= _LEAST_EXCESS
    return is_too_small or (is_too_large and fit.reading in _ORDERS)


def _changed_edges(graph: PoseGraph, other: PoseGraph) -> BoolArray:
    """Whether edges of two readings of a file differ, (m,)."""
    changed = graph.i != other.i
    for name in ("R_ij", "t_ij", "kappa", "tau", "information"):
        values = getattr(graph, name)
        if values is not None:
            differs = (values != getattr(other, name)).reshape(graph.num_edges, -1)
            changed = changed | differs.any(axis=1)
    return np.asarray(changed)


def _has_large_angles(name_or_path: str | Path, d: int) -> bool:
    """Whether files in the plane have angles of more than a turn."""
    if d == 3:
        return False
    with warnings.catch_warnings(action="ignore"):
        files = [
            read_lines(path, skip_unknown=True, needs_matrices=False)
            for path in g2o_files(locate(name_or_path))
        ]
    return any((np.abs(file.edges[:, 2]) > _TURN).any() for file in files)


def _with_share(fit: ReadingFit) -> str:
    """Cost and reading, and the cost over its expectation."""
    return f"{fit.cost:.3g} {fit.text} ({fit.times_expected:.3g} times what is expected)"
