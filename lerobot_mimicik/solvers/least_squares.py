"""One damped least-squares step: the least that any solver has to beat.

Position error in m and rotation vector in rad, rotations weighted by a lever of 0.1 m, constant damping, joint limits
and step bound by an active set: no iteration, no memory, no regularising term. The damping is the least of 1e-5, 1e-4
and 1e-3 with which the arm was not caught near singularities; smaller ones are more exact in the open.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.guidance.box_step import bounded_step, step_box
from lerobot_mimicik.kinematics.point_chain import PointChain
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.iterative import MAX_STEP, joint_limits

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm

_LEVER = 0.1  # m per rad: 1 mm counts as much as 0.6 degrees


@register_solver("least_squares")
class LeastSquaresSolver(IKSolver):
    """A single step of damped least squares in the box of the control step; see the module."""

    configuration = (
        "Reference: one damped least-squares step from the measured joints, rotations weighted by 0.1 m/rad, "
        "damping 1e-3, joint limits and at most 0.1 rad by an active set"
    )

    def __init__(self, arm: SerialArm, damping: float = 1e-3, max_step: float = MAX_STEP) -> None:
        """
        Args:
            arm: The arm to solve for.
            damping: Added to the diagonal of J^T J, in m^2/rad^2.
            max_step: Most that a joint may move in one query, rad (m).

        Raises:
            ValueError: If a number is out of range.
        """
        if not damping > 0 or not max_step > 0:
            raise ValueError(f"expected damping > 0 and max_step > 0; found {damping} and {max_step}")
        self.arm, self.damping, self.max_step = arm, damping, max_step
        self.lower, self.upper = joint_limits(arm)
        self._chain = PointChain(arm.description)

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) after one step."""
        lower, upper = step_box(q_curr, self.lower, self.upper, self.max_step)
        # A joint measured outside its limits is led back first.
        q = np.clip(q_curr, lower, upper)
        rotation, position, jacobian = self._chain.rotation_position_jacobian(q)
        turn = (Rotation.from_quat(target_pose[3:]) * Rotation.from_matrix(rotation).inv()).as_rotvec()
        weights = np.repeat([1.0, _LEVER], 3)
        error = weights * np.concatenate([target_pose[:3] - position, turn])
        step = bounded_step(weights[:, None] * jacobian, error, self.damping, lower - q, upper - q)
        return np.clip(q + step, lower, upper)
