"""The guided solver, without a checkpoint and with one: what `MimicIKAdapter` runs, as rows of every table."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_mimicik.guidance.approach import towards
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm

_LARGEST = np.array([0.05] * 3 + [0.3] * 3)  # m, rad: what a prior is asked for at once, as in the adapter


@register_solver("guided")
class GuidedSolver(IKSolver):
    """Regularised least squares in two passes, within limits and step bound; see `guidance`."""

    configuration = (
        "This project's guidance with its defaults, one frame at a time: iterated Tikhonov regularisation of velocity "
        "and acceleration, clearance from limits, at most 0.095 rad a frame; what MimicIKAdapter.for_arm runs"
    )

    def __init__(self, arm: SerialArm, **settings: Any) -> None:
        """
        Args:
            arm: The arm to solve for.
            settings: Of `GuidanceSettings`.
        """
        self.arm = arm
        self._guidance = Guidance(arm_model(arm.description), GuidanceSettings.of(settings))
        self._upcoming: Array | None = None

    def reset(self, q: Array) -> None:
        """The arm is at rest at `q` (dof,)."""
        self._guidance.reset(q)
        self._upcoming = None

    def foresee(self, upcoming: Array) -> None:
        """The targets (T, 7) after the next one."""
        self._upcoming = upcoming

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,); see `Guidance.solve`."""
        upcoming, self._upcoming = self._upcoming, None
        return self._guidance.solve(q_curr, target_pose, upcoming, self._prior).q

    _prior: Callable[[Array, Array], Array] | None = None


@register_solver("guided_ahead")
class GuidedAheadSolver(GuidedSolver):
    """The same where the next targets are known."""

    look_ahead = 7
    configuration = (
        "This project's guidance where a chunk of 8 targets is known: velocity and third difference of the whole plan, "
        "every frame within limits and step bound"
    )


@register_solver("mimicik_guided")
class MimicIKGuidedSolver(GuidedSolver):
    """Guidance with the step of a MimicIK checkpoint as its prior."""

    configuration = (
        "This project's guidance with the checkpoint's step as prior, trusted as far as it meets the target; what "
        "MimicIKAdapter.from_pretrained runs"
    )

    def __init__(self, arm: SerialArm, policy: Any, device: str | None = None, **settings: Any) -> None:
        """
        Args:
            arm: The arm to solve for.
            policy: A loaded policy, or a folder or Hub repository to load it from.
            device: Where the policy runs.
            settings: Of `GuidanceSettings`.
        """
        from lerobot_mimicik.solvers.mimicik import MimicIKSolver

        super().__init__(arm, **settings)
        self._learned = MimicIKSolver(arm, policy, device=device)
        self._prior = self._ask

    def reset(self, q: Array) -> None:
        """The arm is at rest at `q` (dof,)."""
        super().reset(q)
        self._learned.reset(q[None])

    def _ask(self, start: Array, target: Array) -> Array:
        waypoint, _ = towards(arm_model(self.arm.description).pose(start), target, -_LARGEST, _LARGEST)
        return self._learned.solve(start[None], waypoint[None])[0]
