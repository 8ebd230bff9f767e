"""Refining whole joint trajectories: Levenberg-Marquardt with one banded solve for a batch of trajectories.

The cost is the one stated in `trajectory_ik`. Its normal matrix couples the joints of a frame to those of the
two frames on each side, through the second differences, and to nothing else: laid out frame by frame it has
2 dof diagonals below the main one. Trajectories laid end to end do not couple at all, so that one banded
Cholesky factorisation steps all of them, each with its own damping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.array_chain import ArrayChain


@dataclass(frozen=True)
class TrajectoryOptions:
    """Weights and limits of the solver.

    Attributes:
        position_scale: Position error that costs 1 [m].
        rotation_scale: Rotation error that costs 1 [rad].
        smoothness: Cost of a squared second difference of 1 rad per frame^2. 1e3 leaves a few micrometres in
            the open and lets the tracking give way only where the arm is singular; 1e6 relaxes visibly there.
        limit_margin: Distance kept from the joint limits [rad].
        approach_iterations: Damped steps from `q_start` to the first frame.
        frame_iterations: Damped steps per frame of the starting pass.
        iterations: At most so many Levenberg-Marquardt steps on whole trajectories.
        max_step: Largest joint change of one damped step [rad].
    """

    position_scale: float = 0.5e-3
    rotation_scale: float = 3.5e-3
    smoothness: float = 1e3
    limit_margin: float = 0.02
    approach_iterations: int = 60
    frame_iterations: int = 2
    iterations: int = 12
    max_step: float = 0.3


@dataclass
class TrajectorySolution:
    """Joints of one trajectory and what is left of the pose error.

    Attributes:
        q: Joints [rad], shape (T, dof).
        position_error: Distance of FK(q) to the target [m], shape (T,).
        rotation_error: Angle between FK(q) and the target [rad], shape (T,).
    """

    q: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray


def pose_residual(
    rotation: np.ndarray, position: np.ndarray, rotation_target: np.ndarray, position_target: np.ndarray
) -> np.ndarray:
    """Motion (N, 6) from a pose to its target, in the base frame.

    Translation [m], then the rotation vector of R_target R^T [rad]. Rotations (N, 3, 3), positions (N, 3).
    """
    error = rotation_target @ rotation.transpose(0, 2, 1)
    twice = np.stack(
        [
            error[:, 2, 1] - error[:, 1, 2],
            error[:, 0, 2] - error[:, 2, 0],
            error[:, 1, 0] - error[:, 0, 1],
        ],
        axis=1,
    )
    sine = 0.5 * np.sqrt((twice**2).sum(axis=1))
    cosine = 0.5 * (error[:, 0, 0] + error[:, 1, 1] + error[:, 2, 2] - 1)
    angle = np.arctan2(sine, cosine)
    vector = twice * (0.5 * angle / np.maximum(sine, 1e-12))[:, None]
    # At half a turn the axis cannot be read off the skew part; any axis will do to get away from there.
    vector[(sine < 1e-9) & (cosine < 0)] = (np.pi, 0.0, 0.0)
    return np.concatenate([position_target - position, vector], axis=1)


@dataclass
class PoseTargets:
    """Target poses of F frames as matrices: `rotation` (F, 3, 3) and `position` (F, 3) [m]."""

    rotation: np.ndarray
    position: np.ndarray

    @classmethod
    def of(cls, poses: np.ndarray) -> PoseTargets:
        """From poses (F, 7)."""
        return cls(Rotation.from_quat(poses[:, 3:]).as_matrix(), poses[:, :3].copy())

    def __getitem__(self, frames: np.ndarray | slice) -> PoseTargets:
        return PoseTargets(self.rotation[frames], self.position[frames])

    def residual(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """What `pose_residual` gives from frames (F, 3, 3), (F, 3) to the targets, (F, 6)."""
        return pose_residual(rotation, position, self.rotation, self.position)


def residual_weights(options: TrajectoryOptions) -> np.ndarray:
    """What the components of a residual are multiplied with, shape (6,)."""
    return np.repeat([1 / options.position_scale, 1 / options.rotation_scale], 3)


def refine_trajectories(
    chain: ArrayChain,
    targets: list[np.ndarray],
    guess: list[np.ndarray],
    lower: np.ndarray,
    upper: np.ndarray,
    options: TrajectoryOptions,
) -> list[TrajectorySolution]:
    """Levenberg-Marquardt on whole trajectories, each with its own damping; finished ones leave the batch."""
    best = [q.copy() for q in guess]
    batch = _Batch(chain, targets, best, options)
    state = batch.evaluate(batch.q)
    damping: np.ndarray = np.full(len(batch.members), 1.0)
    for _ in range(options.iterations):
        step = batch.step(state, damping, lower, upper)
        q_new = np.clip(batch.q + step, lower, upper)
        trial = batch.evaluate(q_new)
        better = trial.cost <= state.cost
        gain = (state.cost - trial.cost) / np.maximum(state.cost, 1e-12)
        chosen = better[batch.owner]
        batch.q[chosen] = q_new[chosen]
        state.take(trial, better, chosen)
        damping = np.clip(np.where(better, damping * 0.2, damping * 10.0), 1e-3, 1e8)
        finished = (better & ((gain < 1e-3) | (trial.cost < 1e-2))) | (damping >= 1e8)
        if finished.any():
            batch.store(best, finished)
            batch, state, damping = batch.without(state, damping, finished)
            if not batch.members:
                break
    batch.store(best, np.ones(len(batch.members), dtype=bool))
    everything = np.concatenate(best)
    residual = PoseTargets.of(np.concatenate(targets)).residual(*chain.forward(everything))
    ends = np.cumsum([len(q) for q in best])[:-1]
    position = np.split(np.linalg.norm(residual[:, :3], axis=1), ends)
    rotation = np.split(np.linalg.norm(residual[:, 3:], axis=1), ends)
    return [TrajectorySolution(q, p, r) for q, p, r in zip(best, position, rotation, strict=True)]


@dataclass
class _Evaluation:
    """Residuals of every frame and the cost of every trajectory of a batch."""

    residual: np.ndarray  # (F, 6), weighted
    jacobian: np.ndarray  # (F, 6, dof), weighted
    bend: np.ndarray  # (F, dof), second differences; zero at the ends of a trajectory
    cost: np.ndarray  # (N,)

    def take(self, other: _Evaluation, members: np.ndarray, frames: np.ndarray) -> None:
        self.residual[frames] = other.residual[frames]
        self.jacobian[frames] = other.jacobian[frames]
        self.bend[frames] = other.bend[frames]
        self.cost[members] = other.cost[members]


class _Batch:
    """Trajectories laid end to end; F frames in all, N trajectories."""

    def __init__(
        self, chain: ArrayChain, targets: list[np.ndarray], q: list[np.ndarray], options: TrajectoryOptions
    ) -> None:
        self._chain, self._options, self._weights = chain, options, residual_weights(options)
        self.members = list(range(len(targets)))
        self._arrange(
            [len(target) for target in targets], PoseTargets.of(np.concatenate(targets)), np.concatenate(q)
        )

    def _arrange(self, lengths: list[int], targets: PoseTargets, q: np.ndarray) -> None:
        self._lengths, self._targets, self.q = lengths, targets, q
        self._starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int)
        self.owner = np.repeat(np.arange(len(lengths)), lengths)
        inside = np.zeros(len(q), dtype=bool)
        inside[1:-1] = (self.owner[2:] == self.owner[:-2]) & (self.owner[1:-1] == self.owner[:-2])
        self._inside = inside

    def evaluate(self, q: np.ndarray) -> _Evaluation:
        rotation, position, jacobian = self._chain.forward_and_jacobian(q)
        residual = self._targets.residual(rotation, position) * self._weights
        bend = np.zeros_like(q)
        bend[1:-1] = q[:-2] - 2 * q[1:-1] + q[2:]
        bend[~self._inside] = 0.0
        per_frame = (residual**2).sum(axis=1) + self._options.smoothness * (bend**2).sum(axis=1)
        return _Evaluation(
            residual, jacobian * self._weights[:, None], bend, np.add.reduceat(per_frame, self._starts)
        )

    def step(
        self, state: _Evaluation, damping: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> np.ndarray:
        """Damped Gauss-Newton step of all trajectories, shape (F, dof), from one banded solve."""
        frames, dof = self.q.shape
        transposed = state.jacobian.transpose(0, 2, 1)
        blocks = transposed @ state.jacobian
        smooth = self._options.smoothness
        slope = (transposed @ state.residual[..., None])[..., 0]
        slope += 2 * smooth * state.bend
        slope[1:] -= smooth * state.bend[:-1]
        slope[:-1] -= smooth * state.bend[1:]
        # D^T D of the second differences D = (1, -2, 1), written per frame.
        inside = self._inside.astype(np.float64) * smooth
        diagonal: np.ndarray = 4 * inside
        diagonal[1:] += inside[:-1]
        diagonal[:-1] += inside[1:]
        first = -2 * (inside[:-1] + inside[1:])
        # A joint that rests on its limit and is pushed outward stays there.
        blocked = ((self.q <= lower) & (slope < 0)) | ((self.q >= upper) & (slope > 0))
        slope[blocked] = 0.0
        banded = np.zeros((2 * dof + 1, frames, dof))
        for row in range(dof):
            for column in range(row + 1):
                banded[row - column, :, column] = blocks[:, row, column]
        banded[0] += (diagonal + damping[self.owner])[:, None] + 1e9 * blocked
        banded[dof, :-1] += first[:, None]
        banded[2 * dof, :-2] += inside[1:-1, None]
        solution = solveh_banded(
            banded.reshape(2 * dof + 1, frames * dof), slope.ravel(), lower=True, check_finite=False
        )
        step = solution.reshape(frames, dof)
        largest = np.maximum.reduceat(np.abs(step).max(axis=1), self._starts)
        return step * np.minimum(1.0, self._options.max_step / np.maximum(largest, 1e-12))[self.owner, None]

    def store(self, into: list[np.ndarray], which: np.ndarray) -> None:
        """Copy the joints of the trajectories `which` into the caller's list."""
        for position in np.flatnonzero(which):
            start = self._starts[position]
            into[self.members[position]] = self.q[start : start + self._lengths[position]].copy()

    def without(
        self, state: _Evaluation, damping: np.ndarray, finished: np.ndarray
    ) -> tuple[_Batch, _Evaluation, np.ndarray]:
        """The batch, its evaluation and damping less the finished trajectories."""
        frames = ~finished[self.owner]
        self.members = [member for member, done in zip(self.members, finished, strict=True) if not done]
        lengths = [length for length, done in zip(self._lengths, finished, strict=True) if not done]
        self._arrange(lengths, self._targets[frames], self.q[frames])
        kept = _Evaluation(
            state.residual[frames], state.jacobian[frames], state.bend[frames], state.cost[~finished]
        )
        return self, kept, damping[~finished]
