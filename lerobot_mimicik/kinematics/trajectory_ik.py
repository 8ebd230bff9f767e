"""Inverse kinematics of whole trajectories: many at once, smooth, within the joint limits.

A frame-by-frame solver follows the pose wherever it leads and jumps where the arm loses a direction. Here the
joints of a whole trajectory are found together, so that a frame near a singularity is settled by the
frames before and after it:

    minimise over q_0 .. q_{T-1}   sum_t |W (log(T_target,t T(q_t)^-1))|^2
                                 + smoothness * sum_t |q_{t-1} - 2 q_t + q_{t+1}|^2
    subject to                     lower <= q_t <= upper

with W = diag(1/position_scale, 1/rotation_scale). A pass of damped least squares, frame after frame and all
trajectories in lockstep, starts a Levenberg-Marquardt iteration on the sum (see `trajectory_refinement`).

Poses are T_base_tool as x y z qx qy qz qw; numpy float64 throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import ArrayChain, array_chain
from lerobot_mimicik.kinematics.plausibility import joint_limits
from lerobot_mimicik.kinematics.trajectory_refinement import (
    PoseTargets,
    TrajectoryOptions,
    TrajectorySolution,
    pose_residual,
    refine_trajectories,
    residual_weights,
)

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm

    Arm = SerialArm | ArmDescription

__all__ = [
    "TrajectoryOptions",
    "TrajectorySolution",
    "forward",
    "joint_range",
    "pose_residual",
    "solve_trajectories",
]


def solve_trajectories(
    arm: Arm,
    targets: Sequence[np.ndarray],
    q_start: np.ndarray,
    options: TrajectoryOptions | None = None,
    warm_start: Sequence[np.ndarray] | None = None,
) -> list[TrajectorySolution]:
    """Joint trajectories whose tool follows the target poses, for N trajectories of any lengths.

    Args:
        arm: The arm; of a `SerialArm` only the description is used.
        targets: N arrays of poses T_base_tool, shapes (T_i, 7).
        q_start: Joints near the first frames [rad], shape (N, dof); they choose the solution branch.
        options: Weights and limits.
        warm_start: N arrays (T_i, dof) to start from in place of the frame-by-frame pass.

    Returns:
        N solutions, in order. Nothing is raised for an unreachable pose: its error says so.

    Raises:
        ValueError: Shapes that do not fit together, empty or non-finite targets.
    """
    options = options or TrajectoryOptions()
    chain = array_chain(_description(arm))
    targets, q_start = _check(chain.dof, targets, q_start, warm_start)
    if not targets:
        return []
    lower, upper = joint_range(arm, options.limit_margin)
    if warm_start is None:
        guess = _frame_by_frame(chain, targets, q_start, lower, upper, options)
    else:
        guess = [np.clip(q, lower, upper) for q in warm_start]
    return refine_trajectories(chain, targets, guess, lower, upper, options)


def joint_range(arm: Arm, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Joint limits less a margin [rad], each (dof,) float64; infinite where a joint turns without end."""
    lower, upper = joint_limits(_description(arm))
    margin_each = np.minimum(margin, 0.25 * (upper - lower))
    return lower + margin_each, upper - margin_each


def forward(arm: Arm, q: np.ndarray) -> np.ndarray:
    """T_base_tool of joints (N, dof) as numpy float64 (N, 7), w >= 0."""
    return array_chain(_description(arm)).pose(q)


def _description(arm: Arm) -> ArmDescription:
    return arm if isinstance(arm, ArmDescription) else arm.description


def _check(
    dof: int,
    targets: Sequence[np.ndarray],
    q_start: np.ndarray,
    warm_start: Sequence[np.ndarray] | None,
) -> tuple[list[np.ndarray], np.ndarray]:
    targets = [np.asarray(target, dtype=np.float64) for target in targets]
    q_start = np.asarray(q_start, dtype=np.float64)
    if q_start.shape != (len(targets), dof):
        raise ValueError(f"q_start must have shape {(len(targets), dof)}, got {q_start.shape}")
    if warm_start is not None and len(warm_start) != len(targets):
        raise ValueError(f"warm_start has {len(warm_start)} trajectories, targets {len(targets)}")
    for index, target in enumerate(targets):
        if target.ndim != 2 or target.shape[1] != 7 or len(target) == 0:
            raise ValueError(f"targets[{index}] must have shape (T, 7) with T > 0, got {target.shape}")
        if not np.isfinite(target).all():
            raise ValueError(f"targets[{index}] holds numbers that are not finite")
        if warm_start is not None and np.shape(warm_start[index]) != (len(target), dof):
            raise ValueError(
                f"warm_start[{index}] must have shape {(len(target), dof)}, got {np.shape(warm_start[index])}"
            )
    return targets, q_start


def _frame_by_frame(
    chain: ArrayChain,
    targets: list[np.ndarray],
    q_start: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    options: TrajectoryOptions,
) -> list[np.ndarray]:
    """Damped least squares along the frames; longest trajectories first, so that the batch only shrinks."""
    lengths = np.array([len(target) for target in targets])
    order = np.argsort(-lengths, kind="stable")
    # Row t * N + n of `stacked` is frame t of the n-th longest trajectory.
    count = len(targets)
    padded = np.tile([0.0, 0, 0, 0, 0, 0, 1], (lengths.max(), count, 1))
    for row, index in enumerate(order):
        padded[: lengths[index], row] = targets[index]
    stacked = PoseTargets.of(padded.reshape(-1, 7))
    q = np.clip(q_start[order], lower, upper)
    found = np.empty((lengths.max(), count, chain.dof))
    for frame in range(lengths.max()):
        alive = int(np.count_nonzero(lengths > frame))
        q = q[:alive]
        steps = options.approach_iterations if frame == 0 else options.frame_iterations
        for _ in range(steps):
            step, error = _damped_step(chain, q, stacked[frame * count : frame * count + alive], options)
            q = np.clip(q + step, lower, upper)
            if error.max() < 1.0:
                break
        found[frame, :alive] = q
    guess: list[np.ndarray] = [np.empty(0)] * count
    for row, index in enumerate(order):
        guess[index] = found[: lengths[index], row].copy()
    return guess


def _damped_step(
    chain: ArrayChain, q: np.ndarray, target: PoseTargets, options: TrajectoryOptions
) -> tuple[np.ndarray, np.ndarray]:
    """One step of damped least squares for a batch (N, dof), and the error before it in units of W."""
    weights = residual_weights(options)
    rotation, position, jacobian = chain.forward_and_jacobian(q)
    residual = target.residual(rotation, position) * weights
    weighted = jacobian * weights[:, None]
    squared = (residual**2).sum(axis=1)
    normal = weighted.transpose(0, 2, 1) @ weighted
    # Damping that vanishes with the error (Sugihara 2011), over a floor that bounds steps at a singularity.
    damping = 1e-4 * squared + 1e2
    normal[:, range(chain.dof), range(chain.dof)] += damping[:, None]
    step = np.linalg.solve(normal, (weighted.transpose(0, 2, 1) @ residual[..., None]))[..., 0]
    largest = np.abs(step).max(axis=1, keepdims=True)
    return step * np.minimum(1.0, options.max_step / np.maximum(largest, 1e-12)), np.sqrt(squared)
