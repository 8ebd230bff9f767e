"""RelaxedIK (its present form RangedIK): one nonlinear optimisation per query, in Rust.

Its cost weighs position (50) and orientation (10) against joint velocity, acceleration and jerk, manipulability, joint
limits and self-collision of capsules along the links; the weights are compiled in. It is given its settings file with
the arm and the link radius of its examples (5 cm), and starts from its own last answer, as it must to know velocities; where
the arm is not within `max_step` of that answer it is started anew at the measured joints. The answer is cut to
the box of the control step.

The wheel has no reset: a new start is a new object, and it reads its URDF relative to the working
directory, which is changed while it is made.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik.guidance.box_step import step_box
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.chain_urdf import BASE, TOOL, chain_urdf
from lerobot_mimicik.solvers.iterative import MAX_STEP, joint_limits

RELAXED_IK = from_extra("relaxed_ik_lib")


@register_solver("relaxed_ik", needs=(RELAXED_IK,))
class RelaxedIKSolver(IKSolver):
    """RelaxedIK's optimisation over pose and motion; see the module."""

    configuration = (
        "Its own weights (position 50, orientation 10, velocity 0.7, acceleration 0.5, jerk 0.3, manipulability 1, "
        "limits 0.1, self-collision 0.01 with links of 5 cm), from its own last answer; cut to joint limits and at most "
        "0.1 rad from the measured joints. After configs/example_settings of "
        "https://github.com/uwgraphics/relaxed_ik_core/tree/ranged-ik"
    )

    def __init__(self, arm: SerialArm, link_radius: float = 0.05, max_step: float = MAX_STEP) -> None:
        """
        Args:
            arm: The arm to solve for.
            link_radius: Of the capsules for self-collision, m.
            max_step: Most that a joint may move in one query, rad (m).
        """
        self.arm, self.link_radius, self.max_step = arm, link_radius, max_step
        self.lower, self.upper = joint_limits(arm)
        self._library: Any = RELAXED_IK.load()
        ordered = [joint.name for joint in arm.description.chain() if joint.movable]
        self._to_chain = np.array([arm.joint_names.index(name) for name in ordered])
        self._urdf = chain_urdf(arm.description)
        self._solver: Any = None
        self._last: Array = np.full(arm.dof, np.inf)

    def reset(self, q: Array) -> None:
        """Start anew at rest at `q`."""
        settings = {
            "urdf": "arm.urdf",
            "link_radius": self.link_radius,
            "base_links": [BASE],
            "ee_links": [TOOL],
            "starting_config": q[self._to_chain].tolist(),
        }
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            Path("configs/urdfs").mkdir(parents=True)
            Path("configs/urdfs/arm.urdf").write_text(self._urdf, encoding="utf-8")
            # JSON is YAML.
            Path("settings.yaml").write_text(json.dumps(settings), encoding="utf-8")
            self._solver = self._library.RelaxedIK("settings.yaml")
        self._last = q.copy()

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,), cut to the box."""
        if self._solver is None or np.abs(q_curr - self._last).max() > self.max_step:
            self.reset(q_curr)
        # Its quaternions are wxyz.
        answer, _ = self._solver.solve(target_pose[:3].copy(), np.roll(target_pose[3:], 1))
        self._last = np.empty_like(q_curr)
        self._last[self._to_chain] = answer
        lower, upper = step_box(q_curr, self.lower, self.upper, self.max_step)
        return np.clip(self._last, lower, upper)
