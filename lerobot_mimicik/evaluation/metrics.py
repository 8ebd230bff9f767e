"""What is measured on rollouts: per frame first, then over all frames of a dataset.

Definitions (position in mm, rotation in degrees, joints in rad, rates in percent of all recorded frames):

- *error*: distance between the tool pose of the command, FK(q_cmd), and the target of that frame.
- *SR@x*: fraction of frames with a position error of at most x mm; *Cartesian spike* is 100 - SR@10mm.
- *delta q*: the command minus the joints that the solver was told, largest joint of the frame.
- *joint spike*, *E-stop*: fraction of frames with delta q over 0.1 and over 0.5 rad (the arm's motor limits at
  20 Hz: a warning, an emergency stop) by more than 1e-6 rad: a solver that keeps a bound does so to rounding.
- *limit violation*: fraction of frames with a command outside a joint's limits by more than 1e-6 rad.
- *non-finite*: number of commands with a NaN or an infinity. Such a command counts as a joint spike and an
  E-stop and succeeds at no threshold; so do, for SR, the frames never reached because of it. Means,
  percentiles and maxima are over the finite commands.
- *jerk*: mean absolute third difference of the command sequence, rad/frame^3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_mimicik.evaluation.rollouts import Rollout
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import pose_error
from lerobot_mimicik.solvers.base import Array

SUCCESS_MM = (1.0, 5.0, 10.0)
JOINT_SPIKE_RAD = 0.1
ESTOP_RAD = 0.5
LIMIT_TOLERANCE_RAD = STEP_TOLERANCE_RAD = 1e-6
REACH_TOLERANCE_M = 1e-4  # what the search for the closest pose leaves of a target in reach
ROTATION_LEVER_M = (
    0.1  # the lever at which a rotation counts as much as a translation, as the stress sets have it
)


@dataclass(frozen=True, eq=False)
class Trace:
    """Per-frame measurements of one rollout of T frames; NaN where there is no finite command.

    Attributes:
        rollout: What was measured.
        position_mm: Position error, (T,).
        rotation_deg: Rotation error, (T,).
        max_dq: Largest absolute joint step from `q_curr` to `q_cmd`, (T,), rad; inf where the command is
            not finite, NaN where none was asked for.
        outside_limits: Whether the command leaves the joint limits, (T,).
        tool: `T_base_tool` of the command, (T, 7).
    """

    rollout: Rollout
    position_mm: Array
    rotation_deg: Array
    max_dq: Array
    outside_limits: NDArray[np.bool_]
    tool: Array

    @property
    def in_reach(self) -> NDArray[np.bool_]:
        """Whether the arm can have the target's pose, (T,); True where the dataset does not say."""
        trajectory = self.rollout.trajectory
        if trajectory.closest is None:
            return np.ones(len(trajectory), dtype=bool)
        return np.asarray(pose_cost(trajectory.closest, trajectory.target) <= REACH_TOLERANCE_M)


def measure(arm: SerialArm, rollouts: Sequence[Rollout]) -> list[Trace]:
    """Measure rollouts frame by frame; `arm` should be float64, in the joint order of the rollouts."""
    return [_measure_one(arm, rollout) for rollout in rollouts]


def _measure_one(arm: SerialArm, rollout: Rollout) -> Trace:
    q_cmd, frames = rollout.q_cmd, len(rollout.q_cmd)
    finite = np.isfinite(q_cmd).all(axis=1)
    position, rotation = np.full(frames, np.nan), np.full(frames, np.nan)
    tool = np.full((frames, 7), np.nan)
    if finite.any():
        reached = arm.forward(torch.from_numpy(q_cmd[finite]))
        tool[finite] = reached.numpy()
        distance, angle = pose_error(reached, torch.from_numpy(rollout.trajectory.target[finite]))
        position[finite], rotation[finite] = 1e3 * distance.numpy(), np.degrees(angle.numpy())
    max_dq = np.full(frames, np.nan)
    max_dq[: rollout.asked] = np.inf
    max_dq[finite] = np.abs(q_cmd[finite] - rollout.q_curr[finite]).max(axis=1)
    lower, upper = arm.lower.double().numpy(), arm.upper.double().numpy()
    outside = (q_cmd < lower - LIMIT_TOLERANCE_RAD) | (q_cmd > upper + LIMIT_TOLERANCE_RAD)
    return Trace(rollout, position, rotation, max_dq, np.asarray(outside.any(axis=1)), tool)


def pose_cost(poses: Array, targets: Array) -> Array:
    """Distance (T,) in m between poses (T, 7), rotations weighted by `ROTATION_LEVER_M`; NaN stays NaN."""
    distance, angle = pose_error(torch.from_numpy(poses), torch.from_numpy(targets))
    return np.hypot(distance.numpy(), ROTATION_LEVER_M * angle.numpy())


def jerk_of(commands: Array) -> Array:
    """Absolute third differences, (T - 3, dof), of a command sequence (T, dof); rad/frame^3."""
    return np.abs(np.diff(commands, n=3, axis=0))


def summarise(traces: Sequence[Trace]) -> dict[str, float | int | None]:
    """Metrics over all frames of all traces, by the keys of `report.json`; None where nothing is finite.

    Raises:
        ValueError: If there is no trace.
    """
    if not traces:
        raise ValueError("There is no trajectory to summarise.")
    position = np.concatenate([trace.position_mm for trace in traces])
    rotation = np.concatenate([trace.rotation_deg for trace in traces])
    max_dq = np.concatenate([trace.max_dq for trace in traces])
    outside = np.concatenate([trace.outside_limits for trace in traces])
    jerk = np.concatenate([jerk_of(trace.rollout.q_cmd).ravel() for trace in traces])
    frames = len(position)

    # A NaN compares false: frames without a finite command succeed nowhere and lie outside no limit.
    success = {f"sr{limit:.0f}": _percent(position <= limit) for limit in SUCCESS_MM}
    return {
        "frames": frames,
        "mean_mm": _over_finite(np.mean, position),
        "p95_mm": _over_finite(_p95, position),
        "max_mm": _over_finite(np.max, position),
        "rot_mean_deg": _over_finite(np.mean, rotation),
        "rot_p95_deg": _over_finite(_p95, rotation),
        **success,
        "cartesian_spike": 100.0 - success["sr10"],
        "joint_spike": _percent(max_dq > JOINT_SPIKE_RAD + STEP_TOLERANCE_RAD),
        "estop": _percent(max_dq > ESTOP_RAD + STEP_TOLERANCE_RAD),
        "max_dq": _over_finite(np.max, max_dq),
        "limit_violations": _percent(outside),
        "nonfinite": int(np.isposinf(max_dq).sum()),
        "jerk": _over_finite(np.mean, jerk),
    }


def _percent(mask: NDArray[np.bool_]) -> float:
    return 100.0 * float(mask.mean())


def _p95(values: Array) -> float:
    return float(np.percentile(values, 95))


def _over_finite(reduce, values: Array) -> float | None:
    """`reduce` over the finite values, None where there are none."""
    finite = values[np.isfinite(values)]
    return float(reduce(finite)) if finite.size else None
