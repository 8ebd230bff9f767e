"""A comfortable configuration for an arm whose description names none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.collision import ArmCollision

_SAMPLES = 2048
_MIDDLE = 0.6  # share of each joint's range, about its middle, in which a home is looked for
_LEVER_M = 0.15  # weighs rotation against translation in singular values


def with_home(description: ArmDescription) -> ArmDescription:
    """The description itself if it has a home, else with one that was found; always the same for an arm.

    Of random configurations in the middle of the joints' ranges, free of collisions with the arm and the floor,
    it is the one farthest from a singularity.
    """
    if description.home:
        return description
    joints = description.joints()
    lower = np.array([joint.lower if math.isfinite(joint.lower) else -math.pi for joint in joints])
    upper = np.array([joint.upper if math.isfinite(joint.upper) else math.pi for joint in joints])
    middle, half = 0.5 * (upper + lower), 0.5 * (upper - lower)
    q = middle + _MIDDLE * half * np.random.default_rng(0).uniform(-1, 1, (_SAMPLES, len(joints)))
    jacobian = array_chain(description).forward_and_jacobian(q)[2] * np.repeat([1.0, _LEVER_M], 3)[:, None]
    margin = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
    clear = ArmCollision(description, middle).clearance(q) > 0
    best = int(np.argmax(np.where(clear, margin, margin - margin.max() - 1.0)))
    return replace(description, home=tuple(float(round(value, 4)) for value in q[best]))
