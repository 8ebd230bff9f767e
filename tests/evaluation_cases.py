"""What the tests of solvers and evaluation share: a real solver, and trajectories to follow."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import relative_pose
from lerobot_mimicik.solvers.base import Array, IKSolver

FPS = 20.0


@cache
def airbot() -> SerialArm:
    """The AIRBOT Play in float64."""
    return SerialArm(describe_arm("airbot_play"), dtype=torch.float64)


class DampedLeastSquares(IKSolver):
    """Newton steps with constant damping, as a textbook has it; batched."""

    name = "dls"
    batched = True

    def __init__(self, arm: SerialArm, iterations: int = 5, damping: float = 1e-3) -> None:
        self.arm, self.iterations, self.damping = arm, iterations, damping

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """Commands (B, dof)."""
        q, target = torch.from_numpy(q_curr), torch.from_numpy(target_pose)
        for _ in range(self.iterations):
            error = relative_pose(self.arm.forward(q), target)
            if error.abs().max() < 1e-7:
                break
            jacobian = self.arm.jacobian(q)
            gram = jacobian @ jacobian.mT + self.damping**2 * torch.eye(6, dtype=q.dtype)
            q = q + (jacobian.mT @ torch.linalg.solve(gram, error[..., None]))[..., 0]
        return q.numpy()


class Scripted(IKSolver):
    """Says what a function of (q_curr, target_pose, call number) says; one configuration at a time."""

    name = "scripted"

    def __init__(self, answer) -> None:
        self.answer = answer
        self.calls = 0

    def reset(self, q: Array) -> None:
        """Start counting anew."""
        self.calls = 0

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The scripted answer, (dof,)."""
        self.calls += 1
        return self.answer(q_curr, target_pose, self.calls - 1)


def trajectory(
    frames: int = 60, index: int = 0, speed: float = 0.02, through_wrist: bool = False
) -> Trajectory:
    """Smooth motion of the AIRBOT Play whose target at t is the pose one frame later.

    `through_wrist` lets joint 5 cross zero, where the wrist is singular; otherwise it stays away from it.
    """
    arm = airbot()
    home = np.array(arm.description.home)
    t = np.arange(frames + 1)[:, None]
    phase = np.arange(arm.dof)[None] + index
    q = home + 0.3 * (np.sin(speed / 0.3 * t + phase) - np.sin(phase))
    if through_wrist:
        q[:, 4] = np.linspace(0.6, -0.6, frames + 1)
    target = arm.forward(torch.from_numpy(q[1:])).numpy()
    return Trajectory(index, q[:-1], target)
