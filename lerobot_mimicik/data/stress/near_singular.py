"""Through singular configurations with a trembling hand."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion, moves
from lerobot_mimicik.kinematics.tremor import tremor

_LEVER_M = 0.15  # weighs rotation against translation in singular values
_STARTS, _ITERATIONS, _PROBE = 96, 12, 1e-4
_NEAR = 0.1  # fraction of the arm's median smallest singular value that counts as singular
_SCATTER_RAD = 0.05  # how closely the singular configurations are visited
_TREMOR_MM = 1.0


def near_singular(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    """Moves from everyday configurations into singular ones, about there, and out again.

    Raises:
        ValueError: If the arm has no singular configuration within its limits.
    """
    singular = singular_configurations(arm, rng)
    if not len(singular):
        raise ValueError("no singular configuration was found within the arm's joint limits")
    everyday = everyday_motion(arm, round(20 * fps), fps, rng)
    visits = 0

    def draw() -> Array:
        nonlocal visits
        visits += 1
        if visits % 3 == 0:  # two configurations near singularities, then one everyday one
            return everyday[rng.integers(len(everyday))]
        near = singular[rng.integers(len(singular))]
        return np.clip(near + rng.normal(size=near.shape) * _SCATTER_RAD, arm.lower, arm.upper)

    q = moves(arm, draw, frames + 1, fps, rng, start=everyday[0])
    task = f"Through singularities, tremor of {_TREMOR_MM:g} mm"
    return [StressCase.along(arm, q, task, tremor(frames, fps, _TREMOR_MM, rng))]


def singular_configurations(arm: ArmArrays, rng: np.random.Generator) -> Array:
    """Configurations (n, dof), free of collisions, whose smallest singular value is next to zero; possibly none.

    Newton's method on that one number from random configurations, along its gradient by finite differences.
    """
    q = rng.uniform(arm.lower, arm.upper, size=(_STARTS, len(arm.lower)))
    typical = float(np.median(_smallest(arm, q)))
    probes = _PROBE * np.concatenate([np.zeros((1, q.shape[1])), np.eye(q.shape[1])])
    for _ in range(_ITERATIONS):
        value = _smallest(arm, (q[:, None] + probes).reshape(-1, q.shape[1])).reshape(len(q), -1)
        slope = (value[:, 1:] - value[:, :1]) / _PROBE
        step = -value[:, :1] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-6)
        q = np.clip(q + np.clip(step, -0.3, 0.3), arm.lower, arm.upper)
    return q[(_smallest(arm, q) < _NEAR * typical) & arm.free(q)]


def _smallest(arm: ArmArrays, q: Array) -> Array:
    jacobian = arm.jacobian(q) * np.repeat([1.0, _LEVER_M], 3)[:, None]
    return np.linalg.svd(jacobian, compute_uv=False)[:, -1]
