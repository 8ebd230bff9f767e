"""Pink: a quadratic program per iteration, over Pinocchio.

Configured as the library's UR5 arm example (examples/arm_ur5.py: a `FrameTask`, position and orientation cost 1, and
a `PostureTask`, cost 1e-3, here towards home), except for what a single query asks for where the example follows a
target over many frames: up to 20 iterations from the measured joints, each solving for the whole displacement
(dt = 1); Levenberg-Marquardt damping 1e-3 per squared error instead of 1, which would leave an error behind; the box
of the control step as the range of `ConfigurationLimit`, with gain 1 (its default of 0.5 goes half way to a limit
at most), in place of `VelocityLimit`; DAQP as the QP solver, which the example prefers too.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL
from lerobot_mimicik.solvers.frame_task import FrameTaskSolver
from lerobot_mimicik.solvers.iterative import posture_of
from lerobot_mimicik.solvers.pinocchio_model import PINOCCHIO, PinocchioModel

PINK, DAQP = from_extra("pink"), from_extra("daqp")


@register_solver("pink", needs=(PINOCCHIO, PINK, DAQP))
class PinkSolver(FrameTaskSolver):
    """Differential inverse kinematics with a frame task, iterated; see the module."""

    configuration = (
        "A FrameTask, costs 1 and 1, LM damping 1e-3; a PostureTask towards home, cost 1e-3; up to 20 quadratic "
        "programs (DAQP) from the measured joints; joint limits and at most 0.1 rad from the measured joints as "
        "ConfigurationLimit. After "
        "https://github.com/stephane-caron/pink/blob/main/examples/arm_ur5.py"
    )
    # The box holds to the QP's tolerance, which is looser than the check.
    _solve_options: ClassVar[dict[str, Any]] = {"safety_break": False}

    def __init__(self, arm: SerialArm, **options: Any) -> None:
        """
        Args:
            arm: The arm to solve for.
            options: See `FrameTaskSolver`.
        """
        super().__init__(arm, **options)
        self._package = PINK.load()
        self._library = PinocchioModel(arm.description)
        model = self._library.model
        self._task = self._package.FrameTask(TOOL, **self.costs)
        self._posture = self._package.PostureTask(cost=self.posture_cost)
        self._posture.set_target(self._library.to_model(posture_of(arm)))
        self._limits = [self._package.limits.ConfigurationLimit(model, config_limit_gain=1.0)]
        neutral = self._library.to_model(np.clip(np.zeros(arm.dof), self.lower, self.upper))
        self._configuration = self._package.Configuration(model, self._library.data, neutral)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        # The limit reads the model's range at every query.
        self._library.model.lowerPositionLimit = self._library.to_model(lower)
        self._library.model.upperPositionLimit = self._library.to_model(upper)
        self._task.set_target(self._library.target(target_pose))
        self._configuration.update(self._library.to_model(q))

    def _joints(self) -> Array:
        return np.asarray(self._configuration.q)[self._library.index]
