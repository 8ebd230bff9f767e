"""mink: a quadratic program per iteration, over MuJoCo.

Configured as the library's arm examples (examples/arm_iiwa.py, arm_aloha.py, arm_ur5e_actuators.py: one `FrameTask`,
position and orientation cost 1, up to 20 iterations per frame) with the `PostureTask` that its documentation gives
as example, cost 1e-3 towards home: without it the arm is caught near singularities. What a single query asks for beyond
the examples, which follow a target over many frames: each iteration solves for the whole displacement (dt = 1);
Levenberg-Marquardt damping 1e-3 per squared error instead of 1, and 1e-9 instead of 1e-3 on all joints, which
would leave an error behind; the box of the control step as the range of `ConfigurationLimit`, with gain 1
(its default of 0.95 keeps off the limits a little), in place of `VelocityLimit`; no collision limits; DAQP,
the QP solver that mink itself depends on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf, pose_matrix
from lerobot_mimicik.solvers.frame_task import FrameTaskSolver
from lerobot_mimicik.solvers.iterative import posture_of

MUJOCO, MINK, DAQP = from_extra("mujoco"), from_extra("mink"), from_extra("daqp")


@register_solver("mink", needs=(MUJOCO, MINK, DAQP))
class MinkSolver(FrameTaskSolver):
    """Differential inverse kinematics with a frame task, iterated; see the module."""

    configuration = (
        "A FrameTask, costs 1 and 1, LM damping 1e-3; a PostureTask towards home, cost 1e-3; up to 20 quadratic "
        "programs (DAQP) from the measured joints; joint limits and at most 0.1 rad from the measured joints as "
        "ConfigurationLimit. After https://github.com/kevinzakka/mink/blob/main/examples/arm_iiwa.py and the docs "
        "of PostureTask"
    )

    def __init__(self, arm: SerialArm, **options: Any) -> None:
        """
        Args:
            arm: The arm to solve for.
            options: See `FrameTaskSolver`.
        """
        super().__init__(arm, **options)
        self._package = MINK.load()
        model = _compile(arm.description)
        self._index = np.array([model.joint(name).qposadr[0] for name in arm.joint_names])
        self._task = self._package.FrameTask(TOOL, "body", **self.costs)
        self._posture = self._package.PostureTask(model, cost=self.posture_cost)
        self._posture.set_target(self._to_model(posture_of(arm)))
        self._limits = [self._package.ConfigurationLimit(model, gain=1.0)]
        self._configuration = self._package.Configuration(model)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        (limit,) = self._limits
        limit.lower[self._index], limit.upper[self._index] = lower, upper
        self._task.set_target(self._package.SE3.from_matrix(pose_matrix(target_pose)))
        self._configuration.update(self._to_model(q))

    def _to_model(self, q: Array) -> Array:
        q_model = np.empty_like(q)
        q_model[self._index] = q
        return q_model

    def _joints(self) -> Array:
        return np.array(self._configuration.q)[self._index]


def _compile(description: ArmDescription) -> Any:
    """The bare chain as a MuJoCo model. Static links are kept: the tool frame is one."""
    compiler = '<mujoco><compiler fusestatic="false"/></mujoco>'
    urdf = chain_urdf(description).replace("</robot>", f"{compiler}</robot>")
    return MUJOCO.load().MjModel.from_xml_string(urdf)
