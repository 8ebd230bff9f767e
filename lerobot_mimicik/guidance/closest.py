"""Which configuration near the present one comes closest to a pose: damped least squares within joint limits.

The adapter asks this when its solver did not reach the target, to say whether the arm could have.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.point_chain import PointChain

Array = NDArray[np.float64]
_LENGTH = 0.1  # m, the lever at which a rotation counts as much as a translation
# A controller waits for this: it ends at 30 micrometres, or where a step gains next to nothing.
_MET, _SLOW = 1e-9, 1e-4


def closest_configuration(
    chain: PointChain, lower: Array, upper: Array, q: Array, target: Array, iterations: int = 15
) -> Array:
    """The configuration (dof,) [rad] that a descent from `q` ends at, within `lower` and `upper` (dof,).

    Levenberg-Marquardt on the pose error, rotations weighted by a lever of 10 cm; joints at a limit that the
    step would pass are left out of it. The result is a local optimum: a target that can only be reached in
    another branch of the inverse kinematics is not found.

    Args:
        chain: the arm.
        lower, upper: joint limits.
        q: where to begin.
        target: `T_base_tool` (7,).
        iterations: most steps.
    """
    goal = Rotation.from_quat(target[3:])
    q = np.clip(q, lower, upper)
    damping = 1e-4
    error, jacobian = _error(chain, q, target, goal)
    for _ in range(iterations):
        cost = float(error @ error)
        if cost < _MET:
            break
        normal, slope = jacobian.T @ jacobian, jacobian.T @ error
        stuck = ((q <= lower) & (slope < 0)) | ((q >= upper) & (slope > 0))
        free = ~stuck
        if not free.any():
            break
        step = np.zeros_like(q)
        damped = normal[np.ix_(free, free)] + damping * np.eye(int(free.sum()))
        step[free] = np.linalg.solve(damped, slope[free])
        candidate = np.clip(q + step, lower, upper)
        found, there = _error(chain, candidate, target, goal)
        if float(found @ found) < cost:
            gained = 1.0 - float(found @ found) / cost
            q, error, jacobian, damping = candidate, found, there, max(damping / 5, 1e-8)
            if gained < _SLOW:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    return q


def _error(chain: PointChain, q: Array, target: Array, goal: Rotation) -> tuple[Array, Array]:
    """Pose error (6,) [m] and its derivative by the joints, sign turned, (6, dof)."""
    rotation, position, jacobian = chain.rotation_position_jacobian(q)
    turn = (goal * Rotation.from_matrix(rotation).inv()).as_rotvec()
    weight = np.array([1.0, 1.0, 1.0, _LENGTH, _LENGTH, _LENGTH])
    return weight * np.concatenate([target[:3] - position, turn]), weight[:, None] * jacobian
