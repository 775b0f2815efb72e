"""Directions of a map that no edge measures, and the conventions that hold them.

Where the cost is the same along a direction, a convention says which of the equal maps is meant: an
edge gets information along it. Each convention here is exact. From all poses others of the same
cost lead to where the added term is zero, so that the least cost, and every bound on it, is that of
the file. There are four kinds:

- a single prior: the map can be moved so that it fits, whatever it says;
- an edge between two parts that nothing else joins: one part can be moved so that it fits;
- an axis of the world along which no prior measures a position: the map can be shifted along it;
- the turn about an axis of the world, or about the line of all fixes, that no prior measures: the
  map can be turned about it.
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.bridges import unchecked_bridges
from pgo_models.graphs.pose_graph import (
    IntArray,
    PoseGraph,
    isotropic_information,
    matrices_of_edges,
)
from pgo_models.graphs.precisions import edge_precisions, partial_edges

_AXES = "xyz"
_ROUNDING = 2.0**-44  # share of a matrix that turning it can leave where it has zeros
_MOST_NAMED = 3  # edges that are named one by one


@dataclass(frozen=True, eq=False)
class _Frame:
    """The priors of a graph in the axes of the world."""

    priors: IntArray  # numbers of those of poses
    I_tt: Array  # (k, d, d)
    I_tr: Array  # (k, d, p)
    I_rr: Array  # (k, p, p)
    # (k, d): whether an axis of the world is the same axis of the measured pose, exactly.
    keeps_axis: BoolArray
    # (k,): what counts as zero in I_rr, which is in the axes of the world where this is not zero.
    slack: Array

    @property
    def sees_shift(self) -> BoolArray:
        """Whether a prior measures, or may measure, a shift along an axis, (d,)."""
        is_measured: BoolArray = np.any(self.I_tt, axis=2)
        has_position: BoolArray = np.any(self.I_tt, axis=(1, 2))
        # In turned axes rounding hides what a partial matrix leaves out.
        is_hidden = has_position[:, None] & ~self.keeps_axis
        return np.asarray(np.any(is_measured | is_hidden, axis=0))

    @property
    def sees_turn(self) -> BoolArray:
        """Whether a prior measures, or may measure, a turn about an axis of the world.

        Shape (1,) in the plane and (3,) in space. A position that is measured away from the axis
        does, and so do two rotations about different axes with different information.
        """
        if self.I_rr.shape[1] == 1:
            measures = bool(self.I_tt.any()) or bool(self.I_rr.any())
            return np.array([measures])
        is_seen = [self._sees_turn_about(axis) for axis in range(3)]
        return np.array(is_seen)

    def _sees_turn_about(self, axis: int) -> bool:
        """Whether a prior measures, or may measure, a turn about an axis of the world in space."""
        first, second = (other for other in range(3) if other != axis)
        I_rr = self.I_rr
        slack = self.slack
        measures: BoolArray = np.any(self.I_tt, axis=(1, 2)) | np.any(I_rr, axis=(1, 2))
        is_uneven = np.abs(I_rr[:, first, first] - I_rr[:, second, second]) > slack
        is_uneven |= np.abs(I_rr[:, first, second]) > slack
        reasons = (
            self.I_tt[:, [first, second]],  # a position beside the axis
            self.I_tr,
            np.abs(I_rr[:, axis]) > slack[:, None],
            is_uneven,
            measures & ~self.keeps_axis[:, axis] & (slack == 0.0),
        )
        return any(bool(np.any(reason)) for reason in reasons)


def with_free_directions_held(graph: PoseGraph) -> PoseGraph:
    """Return the graph with conventions for directions that no edge measures.

    Its `free` names the directions and says how they are held. A graph without such directions is
    returned as it is.
    """
    partial = partial_edges(graph)
    if graph.world is None and not partial.any():
        return graph
    if not graph.has_translations or not graph.is_connected:
        return graph
    if partial.any():
        graph = _with_bridges_held(graph, partial)
    if graph.world is None:
        return graph
    if graph.is_prior.sum() == 1:
        return _with_single_prior_held(graph)
    if graph.is_world_loose and not graph.is_prior.all():
        axis = _line_of_fixes(graph)
        if axis is not None:
            return _with_turn_held(graph, axis)
    return _with_frame_held(graph, np.flatnonzero(graph.is_prior))


def _line_of_fixes(graph: PoseGraph) -> Array | None:
    """Axis of the turns of the world that priors of positions leave free, exactly.

    It is a unit vector, (d,), along the line that all measured positions lie on; zeros where they
    are one point, or those of one pose; None where the positions, or what is known of them in some
    direction, fix the turn of the world, if by a little only.
    """
    priors = graph.is_prior
    d = graph.d
    if len(np.unique(graph.j[priors])) == 1:
        return np.zeros(d)  # wherever this pose is, the map turns about it
    if graph.information is not None:
        I_tt = graph.information[priors][:, :d, :d]
        if (I_tt != I_tt[:, :1, :1] * np.eye(d)).any():
            return None
    positions = graph.t_ij[priors]
    offsets = positions - positions[0]
    longest = offsets[np.argmax(np.abs(offsets).max(axis=1))]
    if not longest.any():
        return np.zeros(d)
    products = offsets[:, :, None] * longest
    is_parallel = bool((products == np.swapaxes(products, 1, 2)).all())
    if d == 2 or not is_parallel:
        return None
    return np.asarray(longest / np.linalg.norm(longest))


def _with_turn_held(graph: PoseGraph, axis: Array) -> PoseGraph:
    """The graph of which positions are known on a line along an axis, or in a point (zeros).

    The turns that leave the positions where they are are free. One pose is held.
    """
    candidates = np.flatnonzero(graph.is_prior & ~np.isin(graph.j, graph.landmarks))
    if not len(candidates):
        return graph
    edge = candidates[:1]
    kappa, _ = _usual_weights(graph)
    d = graph.d
    before = isotropic_information(graph.kappa[edge], graph.tau[edge], d)
    usual = isotropic_information(np.array([kappa]), np.zeros(1), d)
    pose = graph.pose_name(int(graph.j[edge[0]]))
    which = "the turn of the map about the point of its fixes"
    if axis.any():
        which = "the turn of the map about the line through its fixes"
        usual[0, d:, d:] = 2.0 * kappa * np.outer(axis, axis)
    text = (
        f"{which} is free: no edge or prior measures it; pose {pose} is held unturned about it, "
        "and variances along it are infinite"
    )
    is_of_F = not axis.any()
    return _with_information(graph, edge, before + usual, text, is_of_F)


def _with_single_prior_held(graph: PoseGraph) -> PoseGraph:
    """The graph whose only prior is an anchor: it has the weights of a usual edge."""
    prior = int(np.flatnonzero(graph.is_prior)[0])
    if graph.j[prior] in graph.landmarks or graph.is_prior.all():
        return graph
    kappa, tau = _usual_weights(graph)
    text = (
        f"the prior of pose {graph.pose_name(int(graph.j[prior]))} is the only one: it places the "
        "map, and says nothing of its shape"
    )
    information = isotropic_information(np.array([kappa]), np.array([tau]), graph.d)
    held = _with_information(graph, np.array([prior]), information, text)
    return _with_rest_of_estimate(held, graph, prior)


def _with_rest_of_estimate(held: PoseGraph, graph: PoseGraph, prior: int) -> PoseGraph:
    """The graph with the estimate of what its only prior does not measure, if it has one."""
    if graph.initial is None or graph.world is None:
        return held
    seen = graph.with_world_of(graph.initial).with_gauge_at(graph.world)
    pose = int(graph.j[prior])
    R_ij = graph.R_ij.copy()
    t_ij = graph.t_ij.copy()
    if graph.kappa[prior] == 0.0:
        R_ij[prior] = seen.R[pose]
    if graph.tau[prior] == 0.0:
        t_ij[prior] = seen.t[pose]
    return replace(held, R_ij=R_ij, t_ij=t_ij)


def _with_bridges_held(graph: PoseGraph, partial: BoolArray) -> PoseGraph:
    """The graph with all of a measurement held where it alone joins two parts."""
    # An edge that measures all of a pose holds its ends together.
    everything = np.ones(graph.num_edges, dtype=bool)
    held = np.flatnonzero(unchecked_bridges(graph, ~partial, everything))
    # The world of a single prior is placed as a whole, and positions alone turn no pose.
    held = held[~graph.is_prior[held] & ~np.isin(graph.j[held], graph.landmarks)]
    if not len(held):
        return graph
    kappa, tau = _usual_weights(graph)
    information = np.repeat(
        isotropic_information(np.array([kappa]), np.array([tau]), graph.d), len(held), axis=0
    )
    names = ", ".join(graph.edge_label(int(e)) for e in held[:_MOST_NAMED])
    if len(held) > _MOST_NAMED:
        names += f" and {len(held) - _MOST_NAMED} more"
    text = (
        "what single edges between two parts of the map leave out is free, and held as they have "
        f"it: {names}"
    )
    return _with_information(graph, held, information, text)


def _with_frame_held(graph: PoseGraph, priors: IntArray) -> PoseGraph:
    """The graph with information along the axes of the world that its priors leave out."""
    frame = _frame_of(graph, priors)
    free_shifts = np.flatnonzero(~frame.sees_shift)
    free_turns = np.flatnonzero(~frame.sees_turn)
    if not len(free_shifts) and not len(free_turns):
        return graph
    d = graph.d
    # The prior that is completed is one that keeps all axes that are free.
    axes = free_shifts
    if d == 3:
        axes = np.union1d(free_shifts, free_turns)
    is_of_pose = ~np.isin(graph.j[priors], graph.landmarks)
    keeps_all = frame.keeps_axis[:, axes].all(axis=1)
    if len(free_shifts) in (0, d):
        keeps_all |= frame.slack > 0.0
    keeps_all &= is_of_pose
    shifts_alone = len(free_shifts) == d and not len(free_turns)
    candidates = is_of_pose if shifts_alone else keeps_all
    if not candidates.any():
        return graph
    with_position = candidates & frame.I_tt.any(axis=(1, 2))
    place = int(np.argmax(with_position if with_position.any() else candidates))
    kappa, tau = _usual_weights(graph)
    usual = isotropic_information(np.array([kappa]), np.array([tau]), d)
    added = np.zeros_like(usual)
    added[0, free_shifts, free_shifts] = usual[0, free_shifts, free_shifts]
    edge = priors[[place]]
    # The axes of turns, in the frame of the measured pose.
    turned = graph.R_ij[edge[0]][free_turns] if d == 3 else np.ones((len(free_turns), 1))
    added[0, d:, d:] = usual[0, d, d] * turned.T @ turned
    before = matrices_of_edges(graph)[edge]
    pose = graph.pose_name(int(graph.j[edge[0]]))
    text = _text_of_frame(d, free_shifts, free_turns, pose)
    held = _with_information(graph, edge, before + added, text, is_of_F=False)
    if len(free_shifts) < d:
        return held
    # Where no prior has a position F has the tau of one, which is exact for it, too.
    tau_of_priors = graph.tau.copy()
    tau_of_priors[edge] = tau
    return replace(held, tau=tau_of_priors)


def _frame_of(graph: PoseGraph, priors: IntArray) -> _Frame:
    """The priors with their matrices, and the axes that they have in common with the world."""
    d = graph.d
    matrices = matrices_of_edges(graph)[priors]
    R = graph.R_ij[priors]
    identity = np.eye(d)
    keeps_axis = (identity == R).all(axis=2) & (identity == R).all(axis=1)
    I_rr = matrices[:, d:, d:]
    slack = np.zeros(len(priors))
    if d == 3 and graph.weights_error > 0.0:
        # Directions such as gravity have been turned to the axes of the poses, with rounding.
        is_turned = ~keeps_axis.all(axis=1) & ~matrices[:, :d].any(axis=(1, 2))
        of_world = R @ I_rr @ np.swapaxes(R, 1, 2)
        I_rr = np.where(is_turned[:, None, None], of_world, I_rr)
        slack = np.where(is_turned, _ROUNDING * np.einsum("kaa->k", I_rr), 0.0)
    return _Frame(priors, matrices[:, :d, :d], matrices[:, :d, d:], I_rr, keeps_axis, slack)


def _text_of_frame(d: int, shifts: IntArray, turns: IntArray, pose: str) -> str:
    """Sentence on the free directions of the frame of the priors."""
    names = []
    if len(shifts) == d:
        names.append("the position of the map")
    elif d == 3 and shifts.tolist() == [2]:
        names.append("the height of the map")
    elif len(shifts):
        along = " and ".join(_AXES[k] for k in shifts)
        names.append(f"the position of the map along {along}")
    if len(turns):
        about = "" if d == 2 else " about " + " and ".join(_AXES[k] for k in turns)
        names.append(f"the turn of the map{about}")
    verb = "is" if len(names) == 1 else "are"
    subject = " and ".join(names)
    return (
        f"{subject} {verb} free: no edge or prior measures it; "
        f"pose {pose} is held where its prior has it, and variances along it are infinite"
    )


def _usual_weights(graph: PoseGraph) -> tuple[float, float]:
    """Medians of the positive kappa and tau of edges between poses."""
    between = ~graph.is_prior
    kappa = graph.kappa[between & (graph.kappa > 0.0)]
    tau = graph.tau[between & (graph.tau > 0.0)]
    kappa_median = float(np.median(kappa)) if len(kappa) else 1.0
    tau_median = float(np.median(tau)) if len(tau) else 1.0
    return kappa_median, tau_median


def _with_information(
    graph: PoseGraph, edges: IntArray, information: Array, text: str, is_of_F: bool = True
) -> PoseGraph:
    """The graph with other information matrices, (k, q, q), of some edges, and what is free.

    F has one weight for all directions: it has new ones only where this is exact for it, too.
    """
    kappa = graph.kappa.copy()
    tau = graph.tau.copy()
    if is_of_F:
        kappa[edges], tau[edges] = edge_precisions(information)
    matrices = graph.information
    if matrices is not None:
        matrices = matrices.copy()
        matrices[edges] = information
    free = f"{graph.free}; {text}" if graph.free else text
    unheld = graph.unheld if graph.unheld is not None else matrices_of_edges(graph)
    return replace(graph, kappa=kappa, tau=tau, information=matrices, free=free, unheld=unheld)
