"""PyBullet: damped least squares by `calculateInverseKinematics`.

Configured as its quickstart guide has it for accuracy: the solver `IK_DLS`, started from the measured
joints (which it reads from the simulated arm), many iterations up to a small residual. Without limits, ranges
and rest poses: these switch PyBullet to its null-space method, which trades the target for the rest
pose. The answer is cut to the box of the control step.

It has no wheel for Python 3.12, and its build from source takes minutes: no extra installs it, and the tests of all
peers include it once it is there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_mimicik.guidance.box_step import step_box
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import Package
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf_file
from lerobot_mimicik.solvers.iterative import MAX_STEP, joint_limits

PYBULLET = Package("pybullet", "uv pip install pybullet (no wheel for Python 3.12: builds for minutes)")


@register_solver("pybullet", needs=(PYBULLET,))
class PyBulletSolver(IKSolver):
    """PyBullet's damped least squares; see the module."""

    configuration = (
        "calculateInverseKinematics with IK_DLS, 100 iterations from the measured joints, "
        "residual 1e-6; the answer is cut to joint limits and at most 0.1 rad from the measured "
        "joints. After the PyBullet quickstart guide"
    )

    def __init__(
        self,
        arm: SerialArm,
        iterations: int = 100,
        residual: float = 1e-6,
        max_step: float = MAX_STEP,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            iterations: Most iterations per query.
            residual: Error at which to stop, in PyBullet's measure.
            max_step: Most that a joint may move in one query, rad (m).
        """
        self.arm, self.iterations, self.residual, self.max_step = arm, iterations, residual, max_step
        self.lower, self.upper = joint_limits(arm)
        self._bullet: Any = PYBULLET.load()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        with chain_urdf_file(arm.description) as path:
            self._body = self._bullet.loadURDF(path, useFixedBase=True, physicsClientId=self._client)
        infos = [
            self._bullet.getJointInfo(self._body, number, physicsClientId=self._client)
            for number in range(self._bullet.getNumJoints(self._body, physicsClientId=self._client))
        ]
        self._tool = next(info[0] for info in infos if info[12].decode() == TOOL)
        movable = [info for info in infos if info[2] != self._bullet.JOINT_FIXED]
        names = [info[1].decode() for info in movable]
        # Answers come in the order of the movable joints; states are set by the joint's own number.
        self._index = np.array([names.index(name) for name in arm.joint_names])
        self._numbers = [movable[index][0] for index in self._index]

    def reset(self, q: Array) -> None:
        """Nothing to forget: each query sets the simulated arm."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,), cut to the box."""
        lower, upper = step_box(q_curr, self.lower, self.upper, self.max_step)
        for number, value in zip(self._numbers, q_curr, strict=True):
            self._bullet.resetJointState(self._body, number, value, physicsClientId=self._client)
        answer = self._bullet.calculateInverseKinematics(
            self._body,
            self._tool,
            target_pose[:3].tolist(),
            target_pose[3:].tolist(),
            solver=self._bullet.IK_DLS,
            maxNumIterations=self.iterations,
            residualThreshold=self.residual,
            physicsClientId=self._client,
        )
        return np.clip(np.array(answer)[self._index], lower, upper)
