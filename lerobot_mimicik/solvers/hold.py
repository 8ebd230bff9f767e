"""Holding still: the command is where the arm already is, which shows what the data alone gives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm


@register_solver("hold")
class HoldSolver(IKSolver):
    """Answers `q_curr` to every question (delta q = 0)."""

    configuration = "The command is the measured joints: what the data alone gives"
    batched = True

    def __init__(self, arm: SerialArm) -> None:
        self.arm = arm

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """`q_curr` itself, whatever the target."""
        return q_curr.copy()

    def solve_recorded(self, q_curr: Array, target_pose: Array) -> Array:
        """`q_curr` itself, all frames at once."""
        return q_curr.copy()
