"""The learned step of one stream of targets, and how much these tremble."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.foresight.features import PAST_STEPS, Features
from lerobot_mimicik.foresight.gauge import TremorGauge
from lerobot_mimicik.foresight.weights import ForesightWeights, load_weights
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import why_not_same_arm

Array = NDArray[np.float64]


class Foresight:
    """Remembers the last targets and commands of one arm; no history begins before `reset`.

    Attributes:
        weights: What was learned.
    """

    def __init__(self, weights: ForesightWeights) -> None:
        self.weights = weights
        self._gauge = TremorGauge(weights.features.history)
        self.reset(np.zeros(weights.features.dof))

    @classmethod
    def load(cls, where: str | Path, arm: ArmDescription | None = None) -> Foresight:
        """By an arm's name, or from a checkpoint's folder.

        Args:
            where: As `weights.load_weights`.
            arm: The arm that it shall be for; None is the weights' own.

        Raises:
            FileNotFoundError, ValueError: As `weights.load_weights`; if the weights are another arm's.
        """
        weights = load_weights(where)
        if arm is None:
            return cls(weights)
        reason = why_not_same_arm(weights.description, arm)
        if reason is not None:
            raise ValueError(f"the foresight weights {where} are another arm's: {reason}")
        # Its tool, its base and its limits are its own.
        return cls(replace(weights, description=arm, features=Features(arm, weights.features.history)))

    @property
    def tremor(self) -> tuple[float, float]:
        """Root mean square of the trembling of the last targets, translation [m] and rotation [rad]."""
        return self._gauge.tremor

    def reset(self, q: Array) -> None:
        """Forget all targets: the arm is at rest at `q` (dof,)."""
        self._targets: Array | None = None
        self._steps = np.zeros((PAST_STEPS, self.weights.features.dof))
        self._last = np.array(q, dtype=float)
        self._gauge.reset()

    def __call__(self, start: Array, target: Array) -> Array:
        """The joints (dof,) to go to from the command in force (dof,), asked for a target (7,)."""
        step = start - self._last
        self._last = start.copy()
        if self._targets is None:
            self._targets = np.repeat(target[None], self.weights.features.history, axis=0)
        else:
            self._targets = np.concatenate([self._targets[1:], target[None]])
            self._steps = np.concatenate([self._steps[1:], step[None]])
        self._gauge.update(target)
        base, observation = self.weights.features(start[None], self._targets[None], self._steps[None])
        return start + self.weights.network(base, observation)[0]
