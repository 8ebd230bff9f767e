"""What one query needs to know of a policy beside its step. No torch is imported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepFacts:
    """What a query needs to know of the policy beside its step.

    Attributes:
        description: The arm whose poses it sees.
        lower, upper: Joint limits [rad], (dof,).
        steps: Frames of history, T_o.
        width: How many numbers the objective draws.
        random: Whether they are random; else zeros.
        seed: Of the random numbers.
    """

    description: ArmDescription
    lower: Array
    upper: Array
    steps: int
    width: int
    random: bool
    seed: int

    @classmethod
    def of(cls, policy: LearnedIKPolicy) -> StepFacts:
        """The facts of a policy."""
        return cls(
            policy.config.arm_description(),
            policy.arm.lower.double().cpu().numpy(),
            policy.arm.upper.double().cpu().numpy(),
            int(policy.config.n_obs_steps),
            policy.objective.draws * policy.config.dof,
            bool(policy.objective.random),
            int(policy.noise_seed),
        )
