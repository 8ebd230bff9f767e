"""The limit: the recorded path refined as a whole, knowing its future.

No online solver can be expected to do better: all frames of a recording are found together by the solver that makes the
project's data (`kinematics/trajectory_refinement.py`), starting from the recorded joints. It keeps joint limits
(less 0.02 rad) and has no bound on the step but its smoothness.
"""

from __future__ import annotations

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.trajectory_ik import TrajectoryOptions, solve_trajectories
from lerobot_mimicik.solvers.base import Array, OfflineSolver, register_solver


@register_solver("limit")
class LimitSolver(OfflineSolver):
    """Whole-trajectory least squares from the recorded joints; see the module."""

    configuration = (
        "Reference that knows the future: the recorded joints refined as a whole (Levenberg-Marquardt, 0.5 mm and 0.2 "
        "degrees against second differences), joint limits less 0.02 rad, no bound on the step; latency is its "
        "time per frame"
    )

    def __init__(self, arm: SerialArm, smoothness: float = 1e3, iterations: int = 12) -> None:
        """
        Args:
            arm: The arm to solve for.
            smoothness, iterations: See `TrajectoryOptions`.
        """
        self.arm = arm
        self.options = TrajectoryOptions(smoothness=smoothness, iterations=iterations)

    def solve_recorded(self, q_curr: Array, target_pose: Array) -> Array:
        """Commands (T, dof) of all frames, in rad."""
        (solution,) = solve_trajectories(self.arm, [target_pose], q_curr[:1], self.options, [q_curr])
        return solution.q
