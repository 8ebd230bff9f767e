"""Newton's method with the plain pseudo-inverse: what a textbook does, and what jumps at singularities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm

_ITERATIONS = 20
_TOLERANCE = 1e-6  # m and rad, together


@register_solver("undamped")
class UndampedSolver(IKSolver):
    """Newton steps from the measured joints until the pose is met; see the module."""

    configuration = (
        "Reference: up to 20 Newton steps by the pseudo-inverse from the measured joints; no damping, no joint limits, "
        "no bound on the step"
    )

    def __init__(self, arm: SerialArm) -> None:
        self.arm, self._chain = arm, point_chain(arm.description)

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) [rad, m], however far from `q_curr` (dof,) it is."""
        q, wanted = np.array(q_curr, dtype=float), Rotation.from_quat(target_pose[3:])
        for _ in range(_ITERATIONS):
            rotation, position, jacobian = self._chain.rotation_position_jacobian(q)
            turn = (wanted * Rotation.from_matrix(rotation).inv()).as_rotvec()
            error = np.concatenate([target_pose[:3] - position, turn])
            if np.linalg.norm(error) < _TOLERANCE:
                break
            q += np.linalg.lstsq(jacobian, error, rcond=None)[0]
        return q
