"""cuRobo: optimisation of many seeds at once on an NVIDIA GPU.

Configured as the inverse kinematics example of cuRobo 0.7 (``IKSolverConfig.load_from_robot_config`` with 20
seeds, CUDA graph, no collisions), with the measured joints as one of the seeds and as the configuration
to stay near, and thresholds of 0.1 mm and 0.001 rad. The answer is the solution it ranks first, approached by at
most ``max_step`` along the straight line in joint space; where it reports no success the arm is held.

NVIDIA's instructions build it against the installed torch. This was written from its documentation and has
not been run against the library yet: the tests of all peers do so once it is installed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import Package, SolverUnavailable
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import BASE, TOOL, chain_urdf_file
from lerobot_mimicik.solvers.iterative import MAX_STEP

CUROBO = Package(
    "curobo.wrap.reacher.ik_solver",
    "build cuRobo 0.7 on a machine with an NVIDIA GPU, see https://curobo.org/get_started/1_install_instructions.html",
)


@register_solver("curobo", needs=(CUROBO,))
class CuRoboSolver(IKSolver):
    """cuRobo's inverse kinematics; see the module."""

    name = "curobo"
    configuration = (
        "20 seeds and the measured joints, CUDA graph, no collisions, thresholds 0.1 mm and 0.001 "
        "rad, approached by at most 0.1 rad. After "
        "the inverse kinematics example of cuRobo 0.7, https://curobo.org; not run here"
    )

    def __init__(
        self,
        arm: SerialArm,
        seeds: int = 20,
        position_threshold: float = 1e-4,
        rotation_threshold: float = 1e-3,
        max_step: float = MAX_STEP,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            seeds: Optimised at once, the measured joints among them.
            position_threshold, rotation_threshold: What counts as success, m and rad.
            max_step: Most that a joint may move in one query, rad (m).

        Raises:
            SolverUnavailable: If there is no CUDA device.
        """
        if not torch.cuda.is_available():
            raise SolverUnavailable("The solver 'curobo' is not available: torch finds no CUDA device")
        from curobo.types.base import TensorDeviceType
        from curobo.types.math import Pose
        from curobo.types.robot import RobotConfig

        self.arm, self.max_step = arm, max_step
        library: Any = CUROBO.load()
        self._pose: Any = Pose
        self._tensors = TensorDeviceType()
        with chain_urdf_file(arm.description) as path:
            robot = RobotConfig.from_basic(path, BASE, TOOL, self._tensors)
        config = library.IKSolverConfig.load_from_robot_config(
            robot,
            None,
            num_seeds=seeds,
            position_threshold=position_threshold,
            rotation_threshold=rotation_threshold,
            self_collision_check=False,
            self_collision_opt=False,
            tensor_args=self._tensors,
            use_cuda_graph=True,
        )
        self._solver = library.IKSolver(config)
        names = list(self._solver.kinematics.joint_names)
        self._index = np.array([names.index(name) for name in arm.joint_names])

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,): towards the solution, or ``q_curr`` where cuRobo finds none."""
        ordered = np.empty_like(q_curr)
        ordered[self._index] = q_curr
        start = self._tensors.to_device(torch.from_numpy(ordered)[None])
        position = self._tensors.to_device(torch.from_numpy(target_pose[None, :3]))
        # Its quaternions are wxyz.
        quaternion = self._tensors.to_device(torch.from_numpy(np.roll(target_pose[3:], 1)[None]))
        result = self._solver.solve_single(
            self._pose(position, quaternion), retract_config=start, seed_config=start[None]
        )
        if not bool(result.success.any()):
            return q_curr.copy()
        solution = result.solution.reshape(-1, len(q_curr))[0].double().cpu().numpy()[self._index]
        step = solution - q_curr
        largest = np.abs(step).max()
        return q_curr + step * min(1.0, self.max_step / largest) if largest > 0 else q_curr.copy()
