"""How much of a target's orientation an arm can serve, and what counts as reached where it cannot serve all.

An arm with five joints moves its tool in five directions at most: whatever the weights, one turn of the tool follows from
the rest. There the position comes first and is met exactly, and the orientation is followed as far as it goes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.guidance.kinematics_kernels import pose_and_jacobian
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.settings import GuidanceSettings, PoseTask, named_axis

Array = NDArray[np.float64]

_SAMPLES = 64  # configurations whose best conditioning counts
_SERVED = 0.05
"""Of the largest singular value: an arm serves a direction in which it moves by so much somewhere (six-joint arms by 0.13
and more; the SO-101 turns its gripper to the side by 0.02, about the jaw's offset from the roll axis)."""
_LOST = 1e-3  # of the largest singular value: below that a direction is none of the arm's where it stands
_NEARLY = 1.0 + 2.0 * np.cos(0.05)  # trace of a turn by 0.05 rad: less needs no telling what of it is served
_LEASH = 0.3  # rad: further off than that an orientation pulls no more
_SECOND = 0.4
"""Weight of the orientation where the position comes first: what the last pass has to take back stays small (a tenth of
what it is with 1 on the SO-101), and the orientation still follows within a few frames."""


@dataclass(frozen=True)
class Service:
    """What of a task an arm serves.

    Attributes:
        task: What the descents weigh.
        judged: What decides whether a target is reached.
        position_first: Whether the position is met exactly and the orientation as far as it goes.
        missing: Number of the task's directions that the arm cannot serve.
    """

    task: PoseTask
    judged: PoseTask
    position_first: bool
    missing: int


def service(model: ArmModel, settings: GuidanceSettings) -> Service:
    """What an arm serves of its settings' task and `orientation`."""
    task, orientation = settings.task, settings.orientation
    only_position = replace(task, weight=(*task.weight[:3], 0.0, 0.0, 0.0), axis=(0.0, 0.0, 0.0))
    if orientation == "position":
        return Service(only_position, only_position, False, 0)
    if orientation == "axis":
        task = replace(task, axis=named_axis(settings.tool_axis))
    asked, served = _directions(model, task)
    first = orientation != "full" and (orientation == "ranged" or served < asked) and any(task.weight[:3])
    if not first:
        return Service(task, task, False, asked - served)
    weight = (*task.weight[:3], *(_SECOND * value for value in task.weight[3:]))
    return Service(replace(task, weight=weight), only_position, True, asked - served)


def free_axis(model: ArmModel, q: Array) -> Array | None:
    """The turn that the arm cannot serve where its tool stays in place, as an axis of the tool (3,).

    None where it serves every turn, or fewer than two, so that no single axis is missing.
    """
    rotation, _, jacobian = pose_and_jacobian(q, model.chain)
    jacobian = jacobian / model.unit
    # Joint motions that leave the tool's position: the null space of the upper half.
    _, values, rows = np.linalg.svd(jacobian[:3])
    rank = int((values > _LOST * values[0]).sum())
    left, values, _ = np.linalg.svd(jacobian[3:] @ rows[rank:].T)
    turns = int((values > _LOST).sum())
    if turns != 2:
        return None
    axis = rotation.T @ left[:, 2]
    return axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0)


def unserved_turn(model: ArmModel, q: Array, target: Array) -> float:
    """How far the tool at `q` is turned from a target's rotation (3, 3), the axis that is not served left out [rad]."""
    rotation, _, _ = pose_and_jacobian(q, model.chain)
    turn = rotation.T @ target
    if np.trace(turn) > _NEARLY:
        return float(np.arccos(min(1.0, 0.5 * (np.trace(turn) - 1.0))))
    error = Rotation.from_matrix(turn).as_rotvec()
    axis = free_axis(model, q)
    return float(np.linalg.norm(error if axis is None else error - axis * (axis @ error)))


def within_leash(model: ArmModel, q: Array, rotations: Array) -> Array:
    """Rotations of targets (T, 3, 3) turned back alike, so that the first is at most `_LEASH` from the tool's at `q`.

    What an arm cannot serve may be off by half a turn; followed all at once it would drag the tool off its place.
    """
    rotation, _, _ = pose_and_jacobian(q, model.chain)
    turn = rotations[0] @ rotation.T
    angle = float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    if angle <= _LEASH:
        return rotations
    error = Rotation.from_matrix(turn).as_rotvec()
    back = Rotation.from_rotvec(error * (_LEASH / angle - 1.0)).as_matrix()
    return np.ascontiguousarray(back @ rotations)


@functools.lru_cache(maxsize=16)
def _directions(model: ArmModel, task: PoseTask) -> tuple[int, int]:
    """Number of directions that a task asks for, and of those that the arm moves its tool in."""
    lower, upper = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
    q = np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, model.dof))
    counts = np.array(task.weight) > 0
    turn = np.eye(3)
    if any(task.axis):
        # Rows of the two turns that tilt the axis, in the tool's frame.
        turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [task.axis])[0].as_matrix()[:2]
    served, asked = 0, 0
    for each in q:
        rotation, _, jacobian = pose_and_jacobian(each, model.chain)
        jacobian = jacobian * np.repeat([1.0, model.lever], 3)[:, None] / model.unit
        upper_rows, lower_rows = jacobian[:3], jacobian[3:]
        if task.frame == "tool":
            upper_rows, lower_rows = rotation.T @ upper_rows, rotation.T @ lower_rows
        if any(task.axis):
            lower_rows = turn @ (lower_rows if task.frame == "tool" else rotation.T @ lower_rows)
            rows = np.concatenate([upper_rows[counts[:3]], lower_rows])
        else:
            rows = np.concatenate([upper_rows, lower_rows])[counts]
        asked = len(rows)
        values = np.linalg.svd(rows, compute_uv=False)
        served = max(served, int((values > _SERVED * values[0]).sum()))
    return asked, served
