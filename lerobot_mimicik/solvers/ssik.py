"""ssik: all closed-form solutions, of which the one nearest to the measured joints is the answer.

Used as its documentation tells one to track a trajectory: `solve(T, q_seed=q, max_solutions=1)` with its default
metric (the largest move of a joint is the smallest possible), joint limits respected. Its hard bound, `seed_tolerance`,
is an option and not the default: with 0.1 rad the arm is held for good once the nearest solution is further away
than that (130 mm mean near singularities instead of 3). It knows arms
with six or seven revolute joints; the AIRBOT Play has a spherical wrist and two parallel axes, for which
the solution is closed and exact. Where no solution lies within the limits the arm is held, as ssik's own
tracker does; a solution further away than `max_step` is approached along the straight line in joint space.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.chain import SerialArm, fixed_transform
from lerobot_mimicik.solvers.availability import SolverUnavailable, from_extra
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import pose_matrix
from lerobot_mimicik.solvers.iterative import MAX_STEP, approach, joint_limits

SSIK = from_extra("ssik")


@register_solver("ssik", needs=(SSIK,))
class SsikSolver(IKSolver):
    """Closed-form solutions, the nearest of them; see the module."""

    configuration = (
        "All closed-form solutions within the joint limits, the nearest one (largest joint move "
        "smallest), approached by at most 0.1 rad; held where there is none. After its "
        "documentation on tracking (https://github.com/personalrobotics/ssik)"
    )

    def __init__(
        self,
        arm: SerialArm,
        max_step: float = MAX_STEP,
        seed_tolerance: float | None = None,
        seed_metric: str = "wrap_linf",
    ) -> None:
        """
        Args:
            arm: The arm to solve for: six or seven revolute joints.
            max_step: Most that a joint may move in one query, rad; infinite: jump to the solution.
            seed_tolerance: Solutions with a joint further than so from the measured joints are none, rad; None: any.
            seed_metric: What "nearest" means, of those that ssik knows.

        Raises:
            SolverUnavailable: If the arm is of another kind.
        """
        joints = arm.description.joints()
        if len(joints) not in (6, 7) or any(joint.type == "prismatic" for joint in joints):
            raise SolverUnavailable(
                f"ssik solves arms of six or seven revolute joints; this one has {len(joints)}: "
                + ", ".join(f"{joint.name} ({joint.type})" for joint in joints)
            )
        self.arm, self.max_step = arm, max_step
        self.seed_tolerance, self.seed_metric = seed_tolerance, seed_metric
        self.lower, self.upper = joint_limits(arm)
        ordered = [joint.name for joint in arm.description.chain() if joint.movable]
        self._to_chain = np.array([arm.joint_names.index(name) for name in ordered])
        transforms, axes = _transforms(arm.description)
        # A continuous joint can be brought within half a turn of anywhere; see solve.
        limits = np.clip(
            np.stack([self.lower, self.upper], axis=1)[self._to_chain], -math.pi * 2, math.pi * 2
        )
        ssik: Any = SSIK.load()
        self._solver = ssik.Manipulator.from_transforms(transforms, axes, limits=limits)
        self._solver.prepare()

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,): towards the nearest solution, or `q_curr` where there is none."""
        solutions = self._solver.solve(
            pose_matrix(target_pose),
            q_seed=q_curr[self._to_chain],
            max_solutions=1,
            seed_metric=self.seed_metric,
            seed_tolerance=self.seed_tolerance,
        )
        if not solutions:
            return q_curr.copy()
        nearest = np.empty_like(q_curr)
        nearest[self._to_chain] = solutions[0].q
        endless = np.isinf(self.upper - self.lower)
        turns = np.round((q_curr - nearest) / (2 * math.pi))
        return approach(q_curr, nearest + np.where(endless, 2 * math.pi * turns, 0.0), self.max_step)


def _transforms(description: ArmDescription) -> tuple[Array, Array]:
    """Transforms (dof + 1, 4, 4) between joint frames at zero, base first, tool last; axes (dof, 3)."""
    transforms, axes, offset = [], [], np.eye(4)
    for joint in description.chain():
        offset = offset @ fixed_transform((*joint.origin_xyz, *joint.origin_rpy)).numpy()
        if joint.movable:
            transforms.append(offset)
            axes.append(joint.axis)
            offset = np.eye(4)
    transforms.append(offset @ fixed_transform(description.tool_offset).numpy())
    return np.stack(transforms), np.array(axes)
