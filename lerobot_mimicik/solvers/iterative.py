"""What the numerical solvers share: the box of joints within reach of one control step, and iterating in it.

The box is the joint limits, cut to `max_step` around the measured joints. A solver that searches in it
finds the best command that it may send, which is more than cutting a command found without it.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from lerobot_mimicik.guidance.box_step import step_box
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.plausibility import joint_limits as description_limits
from lerobot_mimicik.solvers.base import Array, IKSolver

MAX_STEP = 0.1
"""Default of `max_step`, rad (m): the step from which evaluation counts a joint spike."""


def joint_limits(arm: SerialArm) -> tuple[Array, Array]:
    """Position limits (dof,), (dof,) of an arm as numpy arrays; infinite for continuous joints."""
    lower, upper = description_limits(arm.description)
    return lower.copy(), upper.copy()


def approach(q: Array, solution: Array, max_step: float) -> Array:
    """The solution (dof,), or where no joint has moved by more than `max_step` on the straight way to it."""
    step = solution - q
    largest = np.abs(step).max()
    return q + step * min(1.0, max_step / largest) if largest > 0 else q.copy()


def posture_of(arm: SerialArm) -> Array:
    """Where posture tasks draw the joints (dof,): the arm's home, else the middle of the ranges (0 where endless)."""
    if arm.description.home:
        return np.array(arm.description.home)
    lower, upper = joint_limits(arm)
    return np.where(np.isfinite(lower + upper), (lower + upper) / 2, 0.0)


class IterativeSolver(IKSolver):
    """Starts from the measured joints and improves them in the box until the error is small enough.

    Subclasses say how: `_start`, `_error`, `_improve` and `_joints`. Nothing is kept from one query
    to the next.
    """

    def __init__(
        self, arm: SerialArm, iterations: int = 20, tolerance: float = 1e-6, max_step: float = MAX_STEP
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            iterations: Most improvements per query.
            tolerance: Norm of the pose error (m and rad, together) at which to stop.
            max_step: Most that a joint may move in one query, rad (m); infinite: as far as its limits.

        Raises:
            ValueError: If a number is out of range.
        """
        if iterations < 1 or tolerance < 0 or not max_step > 0:
            raise ValueError(
                f"expected iterations >= 1, tolerance >= 0 and max_step > 0; found {iterations}, "
                f"{tolerance} and {max_step}"
            )
        self.arm = arm
        self.iterations, self.tolerance, self.max_step = iterations, tolerance, max_step
        self.lower, self.upper = joint_limits(arm)

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) in the box; the nearest found where the target is out of reach of this step."""
        lower, upper = step_box(q_curr, self.lower, self.upper, self.max_step)
        self._start(np.clip(q_curr, lower, upper), target_pose, lower, upper)
        for _ in range(self.iterations):
            if self._error() <= self.tolerance:
                break
            self._improve()
        # The libraries keep their bounds to rounding only.
        return np.clip(self._joints(), lower, upper)

    @abstractmethod
    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        """Take over the start (dof,), the target (7,) and the box (dof,), (dof,)."""

    @abstractmethod
    def _error(self) -> float:
        """Norm of the pose error at the joints of now, m and rad together."""

    @abstractmethod
    def _improve(self) -> None:
        """One iteration."""

    @abstractmethod
    def _joints(self) -> Array:
        """The joints of now, (dof,), in the arm's order."""
