"""Which configuration comes closest to a pose when steps are not bounded, and why it is not closer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.descent import descend
from lerobot_mimicik.guidance.kinematics_kernels import split_poses
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.settings import PoseTask

Array = NDArray[np.float64]

_ITERATIONS = 25
_DAMPING = 1e-2  # as a multiple of the squared pose residual
_GAIN = 1e-4  # a step that gains less of the squared error ends the descent
NO_EXTRA = (np.zeros((0, 0)), np.zeros(0), np.zeros(0))


KernelTask = tuple[Array, Array, bool, Array]


def kernel_task(model: ArmModel, task: PoseTask) -> KernelTask:
    """A task's weights with rotations by the arm's lever, its tolerances, whether axes are the tool's, and its axis."""
    weight = np.array(task.weight) * np.repeat([1.0, model.lever], 3)
    return weight, np.array(task.tolerance), task.frame == "tool", np.array(task.axis)


def closest_configuration(
    model: ArmModel, q: Array, target: Array, task: PoseTask | None = None, iterations: int = _ITERATIONS
) -> Array:
    """The configuration (dof,) that a descent from `q` ends at, within the joint limits.

    A local optimum: a target that only another branch of the inverse kinematics meets is not found.

    Args:
        model: The arm.
        q: Where to begin (dof,).
        target: `T_base_tool` (7,).
        task: Which part of it counts; all.
        iterations: Most descent steps.
    """
    n = model.dof
    x = np.clip(q, model.lower, model.upper)[None].copy()
    start = x[0].copy()
    rotation, position = split_poses(target[None])
    goal = (rotation, position, kernel_task(model, task or PoseTask()))
    costs = (np.zeros(6), start, x.copy(), np.zeros(1), np.ones(2), NO_EXTRA)
    bounds = (model.lower, model.upper, np.zeros(n))
    past, unbounded = np.stack([start] * 3), np.full(n, np.inf)
    descend(x, past, start, unbounded, model.arrays, goal, costs, bounds, iterations, _DAMPING, _GAIN)
    return x[0]
