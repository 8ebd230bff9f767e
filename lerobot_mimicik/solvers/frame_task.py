"""What mink and Pink share: a frame task, a posture task, and one quadratic program per iteration."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.iterative import IterativeSolver


class FrameTaskSolver(IterativeSolver):
    """Each iteration solves for the whole displacement (dt = 1) to the task's target.

    The posture task draws all joints towards the arm's home, or the middle of their ranges where it has none.

    Subclasses set `_package`, the library; `_task`; `_posture`; `_limits`; and `_configuration`.
    """

    _package: Any
    _task: Any
    _posture: Any
    _limits: list[Any]
    _configuration: Any
    _solve_options: ClassVar[dict[str, Any]] = {}

    def __init__(
        self,
        arm: SerialArm,
        position_cost: float = 1.0,
        orientation_cost: float = 1.0,
        posture_cost: float = 1e-3,
        lm_damping: float = 1e-3,
        damping: float = 1e-9,
        qp_solver: str = "daqp",
        tolerance: float = 1e-5,
        **iteration: Any,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            position_cost, orientation_cost: Of the task, per m and per rad.
            posture_cost: Of the posture task, per rad (m) of each joint; 0 leaves it out.
            lm_damping: The frame task's damping per squared error.
            damping: Of all joints, always.
            qp_solver: A name that `qpsolvers` knows.
            tolerance: Norm of the pose error (m and rad, together) at which to stop; the posture keeps it from vanishing.
            iteration: See `IterativeSolver`.
        """
        super().__init__(arm, tolerance=tolerance, **iteration)
        self.costs = {
            "position_cost": position_cost,
            "orientation_cost": orientation_cost,
            "lm_damping": lm_damping,
        }
        self.posture_cost, self.damping, self.qp_solver = posture_cost, damping, qp_solver

    def _error(self) -> float:
        return float(np.linalg.norm(self._task.compute_error(self._configuration)))

    def _improve(self) -> None:
        displacement = self._package.solve_ik(
            self._configuration,
            [self._task, self._posture] if self.posture_cost else [self._task],
            dt=1.0,
            solver=self.qp_solver,
            damping=self.damping,
            limits=self._limits,
            **self._solve_options,
        )
        self._configuration.integrate_inplace(displacement, 1.0)
