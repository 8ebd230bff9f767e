"""EmbodiK: prioritised velocity inverse kinematics in C++, over a Pinocchio of its own.

Used as its basic example: a frame task scaled with elasticity where it cannot be met, a posture task of the second priority
and weight 0.01, the runtime's automatic layout and weighted fallback. A step makes up the whole error (dt 1, gains
1, where the example follows a hand-held target at 100 Hz with gains of 10); several steps from the measured joints; the
box of the control step as joint limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf_file, pose_matrix
from lerobot_mimicik.solvers.iterative import IterativeSolver, posture_of

EMBODIK = from_extra("embodik")


@register_solver("embodik", needs=(EMBODIK,))
class EmbodikSolver(IterativeSolver):
    """Prioritised velocity steps; see the module."""

    configuration = (
        "A frame task (elastic scaling) and a posture task towards home of second priority, weight 0.01, automatic layout "
        "and weighted fallback on, up to 20 steps from the measured joints that each make up the whole error, joint "
        "limits and at most 0.1 rad from the measured joints. After 01_basic_ik_simple.py of "
        "https://github.com/robodreamer/embodik"
    )

    def __init__(self, arm: SerialArm, posture_weight: float = 1e-2, **iteration: Any) -> None:
        """
        Args:
            arm: The arm to solve for.
            posture_weight: Of the posture task.
            iteration: See `IterativeSolver`.
        """
        super().__init__(arm, **iteration)
        library: Any = EMBODIK.load()
        with chain_urdf_file(arm.description) as path:
            self._robot = library.RobotModel(path)
        self._index = np.array([self._robot.get_joint_config_index(name) for name in arm.joint_names])
        self._solver = library.KinematicsSolver(self._robot)
        self._solver.dt = 1.0
        runtime = self._solver.runtime_config()
        runtime.enable_auto_task_layout = runtime.weighted_fallback_enabled = True
        self._solver.configure_runtime(runtime)
        task = self._solver.add_frame_task("tool", TOOL)
        task.priority, task.weight = 0, 1.0
        task.solve_mode = library.TaskSolveMode.SCALE_ELASTIC
        posture = self._solver.add_posture_task("posture")
        posture.priority, posture.weight = 1, posture_weight
        posture.solve_mode = library.TaskSolveMode.MIN_ERROR
        posture.set_target_configuration(self._to_model(posture_of(arm)))
        self._options = library.PositionStepOptions()
        self._options.position_gain = self._options.orientation_gain = 1.0

    def _to_model(self, q: Array) -> Array:
        q_model = np.empty_like(q)
        q_model[self._index] = q
        return q_model

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        self._robot.set_joint_limits(self._to_model(lower), self._to_model(upper))
        self._q, self._target = self._to_model(q), np.asfortranarray(pose_matrix(target_pose))
        self._robot.update_configuration(self._q)

    def _error(self) -> float:
        pose = self._robot.get_frame_pose(TOOL)
        angle = Rotation.from_matrix(pose.rotation.T @ self._target[:3, :3]).magnitude()
        return float(np.hypot(np.linalg.norm(self._target[:3, 3] - pose.translation), angle))

    def _improve(self) -> None:
        result = self._solver.solve_position_step(self._q, self._target, "tool", self._options)
        self._q = np.array(result.q_solution)
        self._robot.update_configuration(self._q)

    def _joints(self) -> Array:
        return self._q[self._index]
