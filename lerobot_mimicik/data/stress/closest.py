"""Which pose that an arm can have is nearest to one that it cannot: the error that no solver can avoid."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.trajectory_refinement import PoseTargets

LEVER_M = 0.1  # the lever at which a rotation counts as much as a translation
_WEIGHT = np.repeat([1.0, LEVER_M], 3)
_RANDOM_STARTS = 6
_ITERATIONS = 25
_MET_M = 1e-5  # a cost below this is a target in reach: nothing to improve
_STEP = 0.095  # rad (m) per frame: what solvers may move


def pose_cost(arm: ArmArrays, q: Array, target: Array) -> Array:
    """Distance (n,) in m of the tool at joints (n, dof) from targets (n, 7), rotations at `LEVER_M`."""
    return np.linalg.norm(_residual(arm, q, PoseTargets.of(target))[0], axis=1)


def descend(arm: ArmArrays, q: Array, target: Array, iterations: int = _ITERATIONS) -> Array:
    """Joints (n, dof) where Levenberg-Marquardt ends, each row from `q` (n, dof), within the joint limits.

    Joints at a limit that the step would pass are left out of it. The results are local optima.
    """
    lower, upper = arm.limits
    goal = PoseTargets.of(target)
    q = np.clip(q, lower, upper)
    damping: Array = np.full(len(q), 1e-4)
    error, jacobian = _residual(arm, q, goal)
    cost = (error**2).sum(axis=1)
    for _ in range(iterations):
        slope = np.einsum("nij,ni->nj", jacobian, error)
        stuck = ((q <= lower) & (slope < 0)) | ((q >= upper) & (slope > 0))
        free = np.where(stuck, 0.0, 1.0)
        reduced = jacobian * free[:, None]
        normal = reduced.transpose(0, 2, 1) @ reduced
        normal += damping[:, None, None] * np.eye(q.shape[1])
        step = np.linalg.solve(normal, (slope * free)[..., None])[..., 0]
        trial = np.clip(q + step, lower, upper)
        found, there = _residual(arm, trial, goal)
        lower_cost = (found**2).sum(axis=1)
        better = lower_cost < cost
        q = np.where(better[:, None], trial, q)
        error = np.where(better[:, None], found, error)
        jacobian = np.where(better[:, None, None], there, jacobian)
        cost = np.where(better, lower_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 10), 1e-9, 1e4)
    return q


def follow_closest(arm: ArmArrays, start: Array, targets: Array) -> Array:
    """Joints (T, dof) that stay as near to targets (T, 7) as they can in steps of at most `_STEP`."""
    q = np.empty((len(targets), len(start)))
    here = start[None]
    for t, target in enumerate(targets):
        found = descend(arm, here, target[None], iterations=4)
        here = here + np.clip(found - here, -_STEP, _STEP)
        q[t] = here[0]
    return q


def closest_poses(arm: ArmArrays, guess: Array, targets: Array, rng: np.random.Generator) -> Array:
    """The poses (T, 7) nearest to targets (T, 7), in any branch of the inverse kinematics that is found.

    The best of descents from `guess` (T, dof), from random configurations, and from the neighbouring frames' best.
    """
    best = descend(arm, guess, targets)
    cost = pose_cost(arm, best, targets)

    def improve(start: Array) -> None:
        rows = np.flatnonzero(cost > _MET_M)
        found = descend(arm, start[rows], targets[rows])
        reached = pose_cost(arm, found, targets[rows])
        better = reached < cost[rows]
        best[rows[better]], cost[rows[better]] = found[better], reached[better]

    lower, upper = arm.lower, arm.upper
    for _ in range(_RANDOM_STARTS):
        improve(rng.uniform(lower, upper, size=guess.shape))
    for shift in (1, -1, 4, -4):
        improve(np.roll(best, shift, axis=0))
    return arm.pose(best)


def _residual(arm: ArmArrays, q: Array, target: PoseTargets) -> tuple[Array, Array]:
    """Weighted pose error (n, 6) and the tool's Jacobian (n, 6, dof), weighted alike."""
    rotation, position, jacobian = array_chain(arm.description).forward_and_jacobian(q)
    return target.residual(rotation, position) * _WEIGHT, jacobian * _WEIGHT[:, None]
