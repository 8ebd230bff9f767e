"""OptIK: a nonlinear optimisation (SLSQP) per query, restarted from random seeds, in Rust.

Used as its notes on Cartesian interpolation say: solution mode "quality", which returns of the solutions found the
one nearest to the seed, the measured joints; no time limit but a number of restarts, and one thread, so that
the answer depends on neither the machine nor the scheduler. The tolerance is 1e-12 instead of 1e-6, which would leave
half a millimetre. A solution further away than `max_step` is approached along the straight line in joint space;
where there is none the arm is held.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.point_chain import PointChain
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import BASE, TOOL, chain_urdf_file, pose_matrix
from lerobot_mimicik.solvers.iterative import MAX_STEP, approach

OPTIK = from_extra("optik")


@register_solver("optik", needs=(OPTIK,))
class OptikSolver(IKSolver):
    """The nearest of several optimised solutions; see the module."""

    configuration = (
        "The solution nearest to the measured joints of 4 starts (they and 3 random ones), mode quality, tolerance "
        "1e-12, no time limit, one thread, joint limits, approached by at most 0.1 rad; held where there is none. "
        "After the application notes of https://github.com/kylc/optik"
    )

    def __init__(
        self, arm: SerialArm, restarts: int = 4, tolerance: float = 1e-12, max_step: float = MAX_STEP
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            restarts: Optimisations per query, the first from the measured joints.
            tolerance: Half the squared norm of the error (m and rad, together) that counts as solved.
            max_step: Most that a joint may move in one query, rad (m); infinite: jump to the solution.
        """
        self.arm, self.max_step = arm, max_step
        optik: Any = OPTIK.load()
        with chain_urdf_file(arm.description) as path:
            self._robot = optik.Robot.from_urdf_file(path, BASE, TOOL)
        self._robot.set_parallelism(1)
        self._config = optik.SolverConfig(
            solution_mode="quality", max_time=0.0, max_restarts=restarts, tol_f=tolerance
        )
        ordered = [joint.name for joint in arm.description.chain() if joint.movable]
        self._to_chain = np.array([arm.joint_names.index(name) for name in ordered])
        self._lower, self._upper = map(np.array, self._robot.joint_limits())
        # It leaves out the fixed joints beyond the last moving one: what they amount to is its `ee_offset`.
        q = np.clip(np.zeros(arm.dof), self._lower, self._upper)
        ours = np.empty(arm.dof)
        ours[self._to_chain] = q
        tool = pose_matrix(PointChain(arm.description).pose(ours))
        self._offset = np.linalg.solve(np.array(self._robot.fk(q)), tool)

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,): towards the nearest solution found, or `q_curr` where there is none."""
        # It panics where the seed is outside the limits.
        seed = np.clip(q_curr[self._to_chain], self._lower, self._upper)
        found = self._robot.ik(self._config, pose_matrix(target_pose), seed, self._offset)
        if found is None:
            return q_curr.copy()
        solution = np.empty_like(q_curr)
        solution[self._to_chain] = found[0]
        return approach(q_curr, solution, self.max_step)
