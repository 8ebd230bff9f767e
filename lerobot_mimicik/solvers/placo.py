"""placo: one quadratic program in C++, as LeRobot uses it, and as its documentation would have it used.

`placo_lerobot` is LeRobot's own `RobotKinematics` called with its defaults: one QP per call, orientation
weight 0.01 beside position weight 1, joint limits kept, no bound on the step. The QP is linearised where its
robot was updated last, so that FK of the measured joints comes first, as in LeRobot's pipelines that observe the
end effector. Joints go through degrees, as there. `placo_lerobot_8` calls it eight times, each from the last answer.

`placo` follows the library's guide "Getting started" (floating base masked, a soft `FrameTask` with weights 1 and 1,
joint limits on) with a regularization task at its default of 1e-6 and a soft joints task towards home of weight 1e-5,
small enough to leave the answer alone in the open; without the joints task the arm is caught near singularities.
Several iterations from the measured joints, each after `update_kinematics`, and the box of the control step as joint
limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf_file, pose_matrix
from lerobot_mimicik.solvers.iterative import IterativeSolver, posture_of

PLACO = from_extra("placo")


@register_solver("placo_lerobot", needs=(PLACO,))
class LeRobotPlacoSolver(IKSolver):
    """LeRobot's inverse kinematics; see the module."""

    configuration = (
        "LeRobot 0.6's own RobotKinematics with its defaults: one quadratic program per call, "
        "position weight 1, orientation weight 0.01, joint limits, no bound on the step"
    )

    def __init__(
        self,
        arm: SerialArm,
        position_weight: float = 1.0,
        orientation_weight: float = 0.01,
        iterations: int = 1,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            position_weight, orientation_weight: As LeRobot's.
            iterations: Quadratic programs per query, each from the last one's answer.
        """
        from lerobot.model.kinematics import RobotKinematics

        self.arm, self.iterations = arm, iterations
        self.weights = {"position_weight": position_weight, "orientation_weight": orientation_weight}
        with chain_urdf_file(arm.description) as path:
            self._kinematics = RobotKinematics(path, TOOL, list(arm.joint_names))

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) after so many steps."""
        degrees = np.rad2deg(q_curr)
        self._kinematics.forward_kinematics(degrees)
        for _ in range(self.iterations):
            degrees = self._kinematics.inverse_kinematics(degrees, pose_matrix(target_pose), **self.weights)
        return np.deg2rad(degrees)


@register_solver("placo_lerobot_8", needs=(PLACO,))
class LeRobotIteratedPlacoSolver(LeRobotPlacoSolver):
    """LeRobot's inverse kinematics with 8 iterations; see the module."""

    configuration = (
        "LeRobot 0.6's RobotKinematics as placo_lerobot, but 8 quadratic programs per call, each from the last one's "
        "answer, as LeRobot's main branch iterates"
    )

    def __init__(self, arm: SerialArm, iterations: int = 8, **options: Any) -> None:
        """See `LeRobotPlacoSolver`."""
        super().__init__(arm, iterations=iterations, **options)


@register_solver("placo", needs=(PLACO,))
class PlacoSolver(IterativeSolver):
    """placo with full orientation weight, iterated; see the module."""

    configuration = (
        "A soft FrameTask, weights 1 and 1, regularization 1e-6, a soft JointsTask towards home, weight 1e-5, up to "
        "20 iterations from the measured joints, joint limits and at most 0.1 rad from the measured joints. After "
        "https://placo.readthedocs.io/en/stable/kinematics/getting_started.html"
    )

    def __init__(
        self,
        arm: SerialArm,
        position_weight: float = 1.0,
        orientation_weight: float = 1.0,
        regularization: float = 1e-6,
        posture_weight: float = 1e-5,
        **iteration: Any,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            position_weight, orientation_weight: Of the frame task.
            regularization: Weight on the squared displacement.
            posture_weight: Weight on the squared distance of each joint from home, or the middle of its range; 0: none.
            iteration: See `IterativeSolver`.
        """
        super().__init__(arm, **iteration)
        placo: Any = PLACO.load()
        with chain_urdf_file(arm.description) as path:
            self._robot = placo.RobotWrapper(path, placo.Flags.ignore_collisions)
        self._solver = placo.KinematicsSolver(self._robot)
        self._solver.mask_fbase(True)
        self._solver.enable_joint_limits(True)
        self._solver.add_regularization_task(regularization)
        if posture_weight:
            posture = self._solver.add_joints_task()
            posture.set_joints(dict(zip(arm.joint_names, posture_of(arm).tolist(), strict=True)))
            posture.configure("posture", "soft", posture_weight)
        self._task = self._solver.add_frame_task(TOOL, np.eye(4))
        self._task.configure(TOOL, "soft", position_weight, orientation_weight)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        for name, value, low, high in zip(self.arm.joint_names, q, lower, upper, strict=True):
            self._robot.set_joint_limits(name, low, high)
            self._robot.set_joint(name, value)
        self._robot.update_kinematics()
        self._target = pose_matrix(target_pose)
        self._task.T_world_frame = self._target

    def _error(self) -> float:
        # The task's own error_norm() is that of the last solve, not of the joints of now.
        difference = np.linalg.inv(self._robot.get_T_world_frame(TOOL)) @ self._target
        angle = Rotation.from_matrix(difference[:3, :3]).magnitude()
        return float(np.hypot(np.linalg.norm(difference[:3, 3]), angle))

    def _improve(self) -> None:
        self._solver.solve(True)
        self._robot.update_kinematics()

    def _joints(self) -> Array:
        return np.array([self._robot.get_joint(name) for name in self.arm.joint_names])
