"""mink: a quadratic program per iteration, over MuJoCo.

Configured as the library's UR5e arm example (examples/arm_ur5e.py: one ``FrameTask``, position and
orientation cost 1), except for what a single query asks for where the example follows a target over many
frames: up to 20 iterations from the measured joints, each solving for the whole displacement (dt = 1);
Levenberg-Marquardt damping 1e-3 per squared error instead of 1, and 1e-9 instead of 1e-3 on all joints, which
would leave an error behind; the box of the control step as the range of ``ConfigurationLimit``, with gain 1
(its default of 0.95 keeps off the limits a little), in place of ``VelocityLimit``; no collision limits; DAQP,
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
from lerobot_mimicik.solvers.iterative import MAX_STEP, IterativeSolver

MUJOCO, MINK, DAQP = from_extra("mujoco"), from_extra("mink"), from_extra("daqp")


@register_solver("mink", needs=(MUJOCO, MINK, DAQP))
class MinkSolver(IterativeSolver):
    """Differential inverse kinematics with a frame task, iterated; see the module."""

    name = "mink"

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
        self._mink: Any = MINK.load()
        model = _compile(arm.description)
        self._index = np.array([model.joint(name).qposadr[0] for name in arm.joint_names])
        self._task = self._mink.FrameTask(
            TOOL,
            "body",
            position_cost=position_cost,
            orientation_cost=orientation_cost,
            lm_damping=lm_damping,
        )
        self._limit = self._mink.ConfigurationLimit(model, gain=1.0)
        self._configuration = self._mink.Configuration(model)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        self._limit.lower[self._index], self._limit.upper[self._index] = lower, upper
        self._task.set_target(self._mink.SE3.from_matrix(pose_matrix(target_pose)))
        q_model = np.empty(len(q))
        q_model[self._index] = q
        self._configuration.update(q_model)

    def _error(self) -> float:
        return float(np.linalg.norm(self._task.compute_error(self._configuration)))

    def _improve(self) -> None:
        displacement = self._mink.solve_ik(
            self._configuration,
            [self._task],
            dt=1.0,
            solver=self.qp_solver,
            damping=self.damping,
            limits=[self._limit],
        )
        self._configuration.integrate_inplace(displacement, 1.0)

    def _joints(self) -> Array:
        return np.array(self._configuration.q)[self._index]


def _compile(description: ArmDescription) -> Any:
    """The bare chain as a MuJoCo model. Static links are kept: the tool frame is one."""
    compiler = '<mujoco><compiler fusestatic="false"/></mujoco>'
    urdf = chain_urdf(description).replace("</robot>", f"{compiler}</robot>")
    return MUJOCO.load().MjModel.from_xml_string(urdf)
