"""Pink: a quadratic program per iteration, over Pinocchio.

Configured as the library's UR5 arm example (examples/arm_ur5.py: one ``FrameTask``, position and
orientation cost 1), except for what a single query asks for where the example follows a target over many
frames: up to 20 iterations from the measured joints, each solving for the whole displacement (dt = 1);
Levenberg-Marquardt damping 1e-3 per squared error instead of 1, which would leave an error behind; the box
of the control step as the range of ``ConfigurationLimit``, with gain 1 (its default of 0.5 goes half way to a
limit at most), in place of ``VelocityLimit``; no ``PostureTask``, which would only pull a six-joint arm off
its target; DAQP as the QP solver, where the example takes whatever is installed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL
from lerobot_mimicik.solvers.iterative import MAX_STEP, IterativeSolver
from lerobot_mimicik.solvers.pinocchio_model import PINOCCHIO, PinocchioModel

PINK, DAQP = from_extra("pink"), from_extra("daqp")


@register_solver("pink", needs=(PINOCCHIO, PINK, DAQP))
class PinkSolver(IterativeSolver):
    """Differential inverse kinematics with a frame task, iterated; see the module."""

    name = "pink"

    def __init__(
        self,
        arm: SerialArm,
        iterations: int = 20,
        tolerance: float = 1e-6,
        max_step: float = MAX_STEP,
        position_cost: float = 1.0,
        orientation_cost: float = 1.0,
        lm_damping: float = 1e-3,
        damping: float = 1e-9,
        qp_solver: str = "daqp",
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            iterations, tolerance, max_step: See ``IterativeSolver``.
            position_cost, orientation_cost: Of the task, per m and per rad.
            lm_damping: The task's damping per squared error.
            damping: Of all joints, always.
            qp_solver: A name that ``qpsolvers`` knows.
        """
        super().__init__(arm, iterations, tolerance, max_step)
        self.damping, self.qp_solver = damping, qp_solver
        self._pink: Any = PINK.load()
        self._library = PinocchioModel(arm.description)
        model = self._library.model
        self._task = self._pink.FrameTask(
            TOOL, position_cost=position_cost, orientation_cost=orientation_cost, lm_damping=lm_damping
        )
        self._limits = [self._pink.limits.ConfigurationLimit(model, config_limit_gain=1.0)]
        neutral = self._library.to_model(np.clip(np.zeros(arm.dof), self.lower, self.upper))
        self._configuration = self._pink.Configuration(model, self._library.data, neutral)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        # The limit reads the model's range at every query.
        self._library.model.lowerPositionLimit = self._library.to_model(lower)
        self._library.model.upperPositionLimit = self._library.to_model(upper)
        self._task.set_target(self._library.target(target_pose))
        self._configuration.update(self._library.to_model(q))

    def _error(self) -> float:
        return float(np.linalg.norm(self._task.compute_error(self._configuration)))

    def _improve(self) -> None:
        displacement = self._pink.solve_ik(
            self._configuration,
            [self._task],
            dt=1.0,
            solver=self.qp_solver,
            damping=self.damping,
            limits=self._limits,
            # The box holds to the QP's tolerance, which is looser than the check.
            safety_break=False,
        )
        self._configuration.integrate_inplace(displacement, 1.0)

    def _joints(self) -> Array:
        return np.asarray(self._configuration.q)[self._library.index]
