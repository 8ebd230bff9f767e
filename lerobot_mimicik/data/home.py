"""A comfortable configuration for an arm that names none: where an operator would begin to work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.collision import ArmCollision
from lerobot_mimicik.kinematics.plausibility import joint_limits

_SAMPLES = 4000
# Length that makes a turn of the tool comparable to a motion [m per rad].
_LEVER = 0.3
# Distance that an arm keeps from itself and the floor [m]; more is no more comfortable.
_CLEAR = 0.03
# Height of the tool above the floor [m], as a fraction of the reach.
_LOWEST = 0.15


def with_home(description: ArmDescription, home: tuple[float, ...] = ()) -> ArmDescription:
    """The arm with a home configuration: the given one, else its own, else the one that `find_home` finds.

    Args:
        description: The arm.
        home: Joints [rad, m], or empty.

    Raises:
        ValueError: The given home has another number of joints, or lies outside their limits.
    """
    if not home and description.home:
        return description
    if not home:
        return replace(description, home=tuple(np.round(find_home(description), 4).tolist()))
    described = replace(description, home=home)
    lower, upper = joint_limits(description)
    for name, value, low, high in zip(description.joint_names, home, lower, upper, strict=True):
        if not low <= value <= high:
            raise ValueError(
                f"home: {name} is {value:g}, outside its limits [{low:.4g}, {high:.4g}] (rad, or m)"
            )
    return described


def find_home(description: ArmDescription, floor: float | None = 0.0) -> np.ndarray:
    """The best of a fixed sample of the joint range, shape (dof,) [rad, m]; the same every time.

    Best is what is furthest from singular and from the joint limits, both as fractions of what the arm can have,
    clear of itself and of the floor, with the tool above the floor.

    Args:
        description: The arm.
        floor: Height of the floor in the base frame [m]; None: no floor.
    """
    lower, upper = joint_limits(description)
    lower, upper = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    half = 0.5 * (upper - lower)
    q = np.random.default_rng(0).uniform(lower, upper, size=(_SAMPLES, len(lower)))
    _, position, jacobian = array_chain(description).forward_and_jacobian(q)
    jacobian[:, 3:] *= _LEVER
    singular = np.linalg.svd(jacobian, compute_uv=False)[:, min(6, len(lower)) - 1]
    margin = (np.minimum(q - lower, upper - q) / np.maximum(half, 1e-9)).min(axis=1)
    score = np.minimum(singular / max(float(singular.max()), 1e-9), margin)
    clear = ArmCollision(description, 0.5 * (lower + upper), floor).clearance(q)
    score += np.minimum(clear / _CLEAR, 1.0)
    if floor is not None:
        lowest = floor + _LOWEST * np.linalg.norm(position, axis=1).max()
        score -= position[:, 2] < lowest
    return q[int(np.argmax(score))]
