"""Pinocchio's closed-loop inverse kinematics: damped and kept in bounds, and the plain pseudo-inverse.

`pinocchio` is the loop of the library's own example ("Inverse kinematics (clik)" in its documentation: log6
of the tool error, its Jacobian by Jlog6, damped least squares, damping 1e-6 as in the C++ version), as one
would bring it to an arm: warm start from the measured joints, full steps (the start is close: the example's
step of 0.1 would need a hundred iterations), Levenberg-Marquardt damping that grows with the squared error
(Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", 2011) so that it
costs no accuracy at the end, joint limits and a bound on the step by an active set: a joint that meets
its bound is fixed there and the others take over its part.

`pinocchio_undamped` is the paper's baseline: the unconstrained pseudo-inverse, warm-started, iterated to
convergence, with neither damping nor limits nor a bound on the step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_mimicik.guidance.box_step import bounded_step
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.iterative import IterativeSolver
from lerobot_mimicik.solvers.pinocchio_model import PINOCCHIO, PinocchioModel


@register_solver("pinocchio", needs=(PINOCCHIO,))
class PinocchioSolver(IterativeSolver):
    """Damped least squares within joint limits and step bound; see the module."""

    configuration = (
        "Damped least squares on log6 of the tool error: damping 1e-6 plus 1e-3 times the squared "
        "error (Sugihara 2011), up to 20 full steps from the measured joints, joint limits and at "
        "most 0.1 rad from the measured joints by an active set. After "
        "https://github.com/stack-of-tasks/pinocchio/blob/devel/examples/inverse-kinematics.cpp"
    )

    def __init__(
        self, arm: SerialArm, damping: float = 1e-6, error_damping: float = 1e-3, **iteration: Any
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            damping: Added to the diagonal of J^T J.
            error_damping: Added to it too, times the squared norm of the error.
            iteration: See `IterativeSolver`.
        """
        super().__init__(arm, **iteration)
        self.damping, self.error_damping = damping, error_damping
        self._library = PinocchioModel(arm.description)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        self._q = self._library.to_model(q)
        self._bounds = self._library.to_model(lower), self._library.to_model(upper)
        self._target = self._library.target(target_pose)

    def _error(self) -> float:
        self._twist = self._library.error(self._q, self._target)
        return float(np.linalg.norm(self._twist))

    def _improve(self) -> None:
        jacobian = self._library.error_jacobian(self._q, self._twist)
        damping = self.damping + self.error_damping * float(self._twist @ self._twist)
        lower, upper = self._bounds
        self._q = self._q + bounded_step(jacobian, -self._twist, damping, lower - self._q, upper - self._q)

    def _joints(self) -> Array:
        return self._q[self._library.index]


@register_solver("pinocchio_undamped", needs=(PINOCCHIO,))
class UndampedPinocchioSolver(IKSolver):
    """Newton steps by the pseudo-inverse, unbounded; see the module. Its commands may lie outside limits."""

    configuration = (
        "The paper's baseline: pseudo-inverse steps from the measured joints, up to 100 or to an "
        "error of 1e-6, without damping, limits or a bound on the step"
    )

    def __init__(self, arm: SerialArm, iterations: int = 100, tolerance: float = 1e-6) -> None:
        """
        Args:
            arm: The arm to solve for.
            iterations: Most Newton steps per query.
            tolerance: Norm of the pose error (m and rad, together) at which to stop.
        """
        self.arm, self.iterations, self.tolerance = arm, iterations, tolerance
        self._library = PinocchioModel(arm.description)

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,), wherever the iterations ended."""
        target = self._library.target(target_pose)
        q = self._library.to_model(q_curr)
        for _ in range(self.iterations):
            error = self._library.error(q, target)
            if not np.linalg.norm(error) > self.tolerance:
                break
            q = q - np.linalg.pinv(self._library.error_jacobian(q, error)) @ error
        return q[self._library.index]
