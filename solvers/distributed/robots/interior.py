"""One robot of the substructured coupling: it holds its interior, and answers the driver in terms of the separators.

Every method is an order of the driver and returns the robot's answer. What goes in and out are arrays on the poses that
the driver solves for, sums, and the two numbers a pose from which the penalty's quantile is taken; interior poses and
edges stay. The whole story of a solve, in rounds, is told by `solvers.distributed.driver`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.newton_polish import move_poses
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    project_to_rotations,
    stack_transposes,
    tangent_dimension,
    unstack_transposes,
)
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from solvers.distributed.robots.elimination import Cut, Elimination, columns_of, eliminate
from solvers.distributed.robots.proof import RobotProof, begin_proof, verify_interior
from solvers.distributed.robots.subgraph import Part, Subgraph
from solvers.network.messages import Message
from solvers.soc.rotation_block import RotationBlock, block_at, stationary_B

# What follows from the subgraph, and factors: all other attributes are remembered.
_FIXED = {"part", "problem", "backend", "robot", "_cuts", "_holds_zero", "_grounds", "_interior_rows"}
_FIXED |= {"_laplacian", "_elimination", "_eliminated"}


class Interior:
    """A robot and what it remembers between orders."""

    def __init__(self, subgraph: Subgraph, backend: CholeskyBackend | None) -> None:
        part = subgraph.part
        assert part is not None, "a robot that counts no edge has nothing to answer"
        self.part: Part = part
        self.problem = part.problem
        self.backend = backend
        self.robot = subgraph.robot
        d, p = self.problem.d, self.problem.num_poses
        self.poses = Poses(np.broadcast_to(np.eye(d), (p, d, d)).copy(), np.zeros((p, d)))
        self.block: RotationBlock | None = None
        self._cuts: dict[tuple[int, ...], Cut] = {
            widths: Cut(columns_of(part.interior, p, widths), columns_of(part.boundary, p, widths), None)
            for widths in ((1,), (1, d), (d, tangent_dimension(d)))
        }
        self._holds_zero = bool(part.poses[0] == 0)
        self._grounds = self._holds_zero and bool(part.in_cover[0] < 0)  # else another robot or the driver does
        self._interior_rows = columns_of(part.interior, p, (1, d))[len(part.interior) :]
        self._laplacian: Elimination | None = None
        self._elimination: Elimination | None = None
        self._eliminated: tuple[csc_array, tuple[int, ...]] | None = None  # of what, and its unknowns a pose
        self._b = np.zeros((0, d))
        self._x = np.zeros((0, d))
        self._step: tuple[Array, Array] | None = None
        self._trial = self._kept = self.poses
        self._proof: RobotProof | None = None

    # The start: chordal relaxation, translations, multipliers.

    def describe(self) -> Message:
        """Diagonal of M on the boundary."""
        diagonal = self.problem.M.data[self.problem.diagonal_positions]
        return {"diagonal": diagonal[self._cuts[(1, self.problem.d)].boundary]}

    def chordal(self) -> Message:
        """M without the constraints, pose 0 at the identity."""
        p, d = self.problem.num_poses, self.problem.d
        K, b = self.problem.M, np.zeros((self.problem.side, d))
        if self._holds_zero:
            fixed = columns_of(np.zeros(1, dtype=np.int64), p, (1, d))
            at = np.concatenate([np.zeros((1, d)), np.eye(d)])
            b -= K[:, fixed] @ at
            data = K.data.copy()
            self.problem.leave_out(data, fixed, 1.0)
            b[fixed] = at
            K = self.problem.with_pattern_of_M(data)
        return self._eliminate(K, (1, d), b)

    def project(self, message: Message) -> Message:
        """Back-substitute the relaxation and project its rotations; then `translations`."""
        X = self._back_substitute(message["x"])
        self.poses = Poses(project_to_rotations(unstack_transposes(X[self.problem.num_poses :])), self.poses.t)
        return self.translations()

    def set_poses(self, message: Message) -> Message:
        """Take poses from elsewhere, (p, d, d) and (p, d), as they are."""
        self.poses = Poses(message["R"], message["t"])
        return {}

    def evaluate(self) -> Message:
        """Parts of F and of M X on the boundary, at the poses at hand."""
        return self._state_of(self.poses)

    def adopt(self, message: Message) -> Message:
        """Take rotations of the cover's poses; then `translations`."""
        R = self.poses.R.copy()
        R[self.part.boundary] = unstack_transposes(message["z"])
        self.poses = Poses(R, self.poses.t)
        return self.translations()

    def save_poses(self) -> Message:
        """Remember the poses at hand."""
        self._kept = self.poses
        return {}

    def restore_poses(self) -> Message:
        """Return to the poses that were kept."""
        self.poses = self._kept
        return {}

    def translations(self) -> Message:
        """Right-hand side of the best translations, and once their matrix."""
        return self._reduced_translations(self.poses.R)

    def set_translations(self, message: Message) -> Message:
        """Take the best translations: this robot's part of F and of M X on the boundary."""
        self.poses = Poses(self.poses.R, self._translations(self.poses.R, message["t"]))
        return self._state_of(self.poses)

    def multiplier_norms(self) -> Message:
        """||Lambda_i||_2 and m_i of the interior poses."""
        norms = np.abs(np.linalg.eigvalsh(self._multipliers()[self.part.interior])).max(axis=1, initial=0.0)
        return {"norms": norms, "scale": self._scale()}

    # SOC.

    def penalize(self, message: Message) -> Message:
        """Set rho_i = max(a ||Lambda_i||, b m_i, c), factor M + D/2; omega is at the poses, B zero or stationary."""
        a, b, c = message["rule"]
        interior = self.part.interior
        Lambda, R = self._multipliers()[interior], self.poses.R[interior]
        norms = np.abs(np.linalg.eigvalsh(Lambda)).max(axis=1, initial=0.0)
        rho = np.maximum(np.maximum(a * norms, b * self._scale()), c)
        B = stationary_B(R, Lambda, rho) if message["is_stationary"][0] else None
        diagonal = self.problem.M.data[self.problem.diagonal_positions][self._interior_rows]
        self.block = block_at(R, rho, diagonal, B)
        return self._penalized()

    def rescale(self, message: Message) -> Message:
        """Multiply rho, from the best iterate on if asked to, and factor again."""
        assert self.block is not None
        block = self.block.back_at_best() if message["from_best"][0] else self.block
        self.block = block.rescaled(float(message["factor"][0]))
        return self._penalized()

    def solve(self, message: Message) -> Message:
        """Step (a) in the interior; this robot's sums for the acceleration."""
        assert self.block is not None
        self._x = self._back_substitute(message["x"])
        alpha, memory = message["alpha"][0], int(message["memory"][0])
        self.block, sums = self.block.after_solve(self._x[self._interior_rows], alpha, memory)
        return {"sums": sums}

    def agree(self, message: Message) -> Message:
        """Steps (b) and (c): sums of the residuals, and the right-hand side of the next step (a)."""
        assert self.block is not None
        gamma = None if message["restart"][0] else message["gamma"]
        self.block, sums = self.block.after_agreement(gamma, bool(message["is_best"][0]))
        return {"sums": sums, **self._reduced(self._pull())}

    def cost(self, message: Message) -> Message:
        """Part of F at omega and the translations of step (a)."""
        X = self._x.copy() if self._x.size else self.problem.stacked(self.poses)
        X[self.problem.num_poses :] = stack_transposes(self._omega(message["z"]))
        return {"objective": np.array([self.problem.objective_stacked(X)])}

    def finish(self, message: Message) -> Message:
        """Take omega for the rotations; then `translations`."""
        self.poses = Poses(self._omega(message["z"]), self.poses.t)
        return self.translations()

    # Newton.

    def model(self, message: Message) -> Message:
        """Hessian (Gauss-Newton where asked for), and the reduced gradient; `definite` is 0 where K_II is not."""
        second_order, damping = message["settings"]
        Lambda = None
        if second_order:
            Lambda = self._multipliers()
            Lambda[self.part.boundary] = 0.0  # the driver knows the whole force there
        H = riemannian_hessian(self.problem, self.poses, Lambda)
        layout = self._layout
        scale = np.ones(layout.side)
        if self._grounds:
            zero = np.zeros(1, dtype=np.int64)
            scale[np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]])] = 2.0
        own = np.zeros(layout.side, dtype=bool)
        own[self._cuts[self._tangent].interior] = True
        diagonal = H.diagonal()
        grounded = np.where(scale > 1.0, diagonal + abs(diagonal), diagonal)
        H.setdiag(np.where(own, grounded * (1.0 + damping), diagonal))
        try:
            answer = self._eliminate(H, self._tangent, self._gradient(self.poses))
        except NotPositiveDefiniteError:
            return {"definite": np.zeros(1)}
        return {**answer, "definite": np.ones(1)}

    def move(self, message: Message) -> Message:
        """Direction -H^-1 g from H^-1 g on the boundary; then `turn`."""
        self._step = self._layout.split(-self._back_substitute(message["x"])[:, 0])
        return self.turn(message)

    def turn(self, message: Message) -> Message:
        """Trial rotations a length along the direction, and the right-hand side of their best translations."""
        assert self._step is not None
        w, v = self._step
        length = message["length"][0]
        self._trial = Poses(move_poses(self.poses, length * w, length * v).R, self.poses.t)
        return self._reduced_translations(self._trial.R)

    def evaluate_trial(self, message: Message) -> Message:
        """Take the trial's best translations: F, force and reduced gradient there, by the factor at hand."""
        self._trial = Poses(self._trial.R, self._translations(self._trial.R, message["t"]))
        return {**self._state_of(self._trial), **self._reduced(self._gradient(self._trial))}

    def accept(self) -> Message:
        """Go to the trial."""
        self.poses = self._trial
        return {}

    # Certificate and answer.

    def certificate(self, message: Message) -> Message:
        """Eliminate S for a proof, and with `point` begin one (`solvers.distributed.robots.proof`)."""
        d, Lambda = self.problem.d, self._multipliers()
        Lambda[self.part.boundary] = 0.0
        trace = np.array([math.fsum(np.einsum("naa->na", Lambda).ravel())])
        self._proof = None
        fixed = self._cuts[(1, d)].boundary[message["fixed"] > 0]
        fixed = np.append(fixed, 0) if "point" not in message and self._grounds else fixed
        eta, least, cut = message["eta"][0], message["share"][0], self._cuts[(1, d)]
        found = verify_interior(self.problem, Lambda, eta, cut, fixed, least, self.backend)
        if found is None:
            return {"definite": np.zeros(1), "trace": trace}
        matrix, self._elimination, slack = found
        self._eliminated, self._cuts[(1, d)] = (matrix, (1, d)), self._elimination.cut
        answer = {"schur": self._elimination.schur, "definite": np.ones(1), "trace": trace}
        if "point" in message:
            self._proof = begin_proof(self.part, self.poses, Lambda, slack, self._elimination.cut, message["point"])
            answer |= self._evaluated()
        return answer

    def move_certificate(self, message: Message) -> Message:
        """Move X by -S_r^-1 G: parts of the bound there."""
        assert self._proof is not None
        self._proof = self._proof.moved(self._back_substitute(message["x"]))
        return self._evaluated()

    def _evaluated(self) -> Message:
        assert self._proof is not None
        sums, product = self._proof.evaluated(self.problem, self._cuts[(1, self.problem.d)].boundary)
        return {**sums, **self._reduced(product)}

    def result(self) -> Message:
        """Interior poses and multipliers, for whoever may see them."""
        interior = self.part.interior
        return {
            "poses": self.part.poses[interior],
            "R": self.poses.R[interior],
            "t": self.poses.t[interior],
            "Lambda": self._multipliers()[interior],
        }

    # What is remembered, and told again.

    def remembered(self) -> dict[str, object]:
        """All that earlier orders left here, with matrices instead of factors: see `solvers.network.serialization`."""
        matrix = None
        if self._eliminated is not None:
            K, widths = self._eliminated
            matrix = {"data": K.data, "indices": K.indices, "indptr": K.indptr, "widths": widths}
        kept = {name: value for name, value in vars(self).items() if name not in _FIXED}
        return {"kept": kept, "matrix": matrix, "has_laplacian": self._laplacian is not None}

    def remember(self, remembered: Mapping[str, Any]) -> None:
        """Go on from what was remembered; factors are found again."""
        for name, value in remembered["kept"].items():
            setattr(self, name, value)
        self._laplacian = self._eliminated_translations() if remembered["has_laplacian"] else None
        self._elimination = self._eliminated = None
        if remembered["matrix"] is not None:
            matrix = remembered["matrix"]
            K, widths = csc_array((matrix["data"], matrix["indices"], matrix["indptr"])), matrix["widths"]
            self._elimination, self._eliminated = eliminate(K, self._cuts[widths], self.backend), (K, widths)

    def eliminated(self) -> Message:
        """Answer of the elimination at hand once more, for a driver that was started again."""
        assert self._elimination is not None
        reduced, energy = self._elimination.reduce(self._b)
        return {"schur": self._elimination.schur, "b": reduced, "energy": np.array([energy])}

    def eliminated_translations(self) -> Message:
        """Matrix of the translations once more, if there has been one."""
        return {"schur": self._laplacian.schur} if self._laplacian is not None else {}

    # What the orders share.

    @property
    def _layout(self) -> TangentLayout:
        return TangentLayout(self.problem.num_poses, self.problem.d)

    @property
    def _tangent(self) -> tuple[int, ...]:
        return (self.problem.d, tangent_dimension(self.problem.d))

    def _eliminate(self, K: csc_array, widths: tuple[int, ...], b: Array) -> Message:
        """Eliminate the interior of K x = b: what the driver needs of it."""
        self._elimination = self._eliminated = None  # its memory may be needed
        self._elimination = eliminate(K, self._cuts[widths], self.backend)
        self._eliminated = K, widths
        self._cuts[widths] = self._elimination.cut  # with the analysis, which is the same the next time
        return {"schur": self._elimination.schur, "diagonal": self._elimination.diagonal, **self._reduced(b)}

    def _reduced(self, b: Array) -> Message:
        """Right-hand side on the boundary, and b_I . K_II^-1 b_I, by the elimination at hand."""
        assert self._elimination is not None
        self._b = b
        reduced, energy = self._elimination.reduce(b)
        return {"b": reduced, "energy": np.array([energy])}

    def _back_substitute(self, x: Array) -> Array:
        assert self._elimination is not None
        return self._elimination.back_substitute(self._b, x)

    def _penalized(self) -> Message:
        assert self.block is not None
        data = self.problem.M.data.copy()
        data[self.problem.diagonal_positions[self._interior_rows]] += 0.5 * self.block.penalty
        if self._grounds:
            data[self.problem.diagonal_positions[0]] *= 2.0
        return self._eliminate(self.problem.with_pattern_of_M(data), (1, self.problem.d), self._pull())

    def _pull(self) -> Array:
        """D/2 (omega - B), (side, d)."""
        assert self.block is not None
        b = np.zeros((self.problem.side, self.problem.d))
        b[self._interior_rows] = (0.5 * self.block.penalty)[:, None] * self.block.shift
        return b

    def _omega(self, z_G: Array) -> Array:
        """Rotations omega of the part's poses, (p, d, d), from the block and the driver's rows."""
        assert self.block is not None
        R = np.empty_like(self.poses.R)
        R[self.part.interior] = unstack_transposes(self.block.z)
        R[self.part.boundary] = unstack_transposes(z_G)
        return R

    def _reduced_translations(self, R: Array) -> Message:
        is_first = self._laplacian is None
        if self._laplacian is None:
            self._laplacian = self._eliminated_translations()
        b = self._laplacian.reduce(self._lever(R))[0]
        return {"schur": self._laplacian.schur, "b": b} if is_first else {"b": b}

    def _eliminated_translations(self) -> Elimination:
        p = self.problem.num_poses
        M_tt = self.problem.M[:p, :p].tocsc()
        if self._grounds:
            M_tt[0, 0] *= 2.0
        return eliminate(M_tt, self._cuts[(1,)], self.backend)

    def _translations(self, R: Array, t_G: Array) -> Array:
        assert self._laplacian is not None
        return self._laplacian.back_substitute(self._lever(R), t_G)

    def _lever(self, R: Array) -> Array:
        """-M_tR Y, (p, d)."""
        p = self.problem.num_poses
        return np.asarray(-(self.problem.M[:p, p:] @ stack_transposes(R)))

    def _state_of(self, poses: Poses) -> Message:
        """Parts of F and of M X on the boundary."""
        force = self.problem.apply_M(self.problem.stacked(poses))[self._cuts[(1, self.problem.d)].boundary]
        objective, level = self.problem.objective(poses), rounding_level(self.problem, poses)
        return {"objective": np.array([objective]), "level": np.array([level]), "force": force}

    def _multipliers(self) -> Array:
        """Lambda_i, right in the interior alone, where the robot has every edge."""
        return multipliers(self.problem, self.poses)

    def _gradient(self, poses: Poses) -> Array:
        return self._layout.join(*self.problem.riemannian_gradient(poses))[:, None]

    def _scale(self) -> Array:
        """m_i of the interior."""
        diagonal = self.problem.M.data[self.problem.diagonal_positions[self._interior_rows]]
        return np.asarray(diagonal.reshape(-1, self.problem.d).mean(axis=1))
