"""One frame or several: the passes of descent that make a command, or a plan, of known targets.

A first pass weighs the pose against smoothness, clearance and a trusted prior. A second one starts from its answer and
is pulled to it only (iterated Tikhonov regularisation): what the first gave up of the pose comes back where the arm is
well conditioned, and stays given up where it is singular.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.descent import COLLISION, JERK, descend, keep_bounds, one_after_the_other
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.search import NO_EXTRA, kernel_task
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.guidance.user_terms import CostTerm, Quadratic, descend_with_terms

Array = NDArray[np.float64]

_DAMPING = 1e-2
"""Levenberg-Marquardt damping as a multiple of the squared pose residual (Sugihara 2011)."""
_GAIN = 1e-4  # fraction of its cost that a descent step must gain for another one to follow


_FAR_APART = 0.06
"""Gap [m] from which bodies are not looked at while frames are improved; the command itself always is."""


class Planner:
    """Descends the costs of one arm; what it answers depends on its arguments only."""

    def __init__(self, model: ArmModel, settings: GuidanceSettings, terms: Sequence[CostTerm] = ()) -> None:
        """
        Args:
            model: The arm.
            settings: Weights and bounds.
            terms: Costs of the user's own.
        """
        self.model, self.settings, self.terms = model, settings, tuple(terms)
        given, size, n = settings, model.reach**2, model.dof
        posture = given.posture * size if n > _constrained(given) else 0.0
        collision = given.collision * size if len(model.pairs) else 0.0
        clearance = given.clearance * size
        one = [given.velocity, given.acceleration, 0.0]
        ahead = [given.ahead_velocity, 0.0, given.ahead_jerk * given.smoothness]
        rest = [clearance, posture, collision]
        self._one = np.array([*(size * value for value in one), *rest])
        self._ahead = np.array([*(size * value for value in ahead), *rest])
        # The second pass keeps a tenth of the third difference: it would otherwise undo what looking ahead is for.
        self._one_exact = np.array([0.0, 0.0, 0.0, 0.0, 0.0, collision])
        self._ahead_exact = np.array([0.0, 0.0, 0.1 * self._ahead[JERK], 0.0, 0.0, collision])
        self._exactness, self._ahead_exactness = size * given.exactness, size * given.ahead_exactness
        self._prior = size * given.prior
        self._task = kernel_task(model, given.task)
        self._bounds = (
            model.lower,
            model.upper,
            model.margins(given.clearance_width, given.clearance_fraction),
        )
        self._step = np.full(n, given.max_step)
        span = max(given.collision_zone - given.collision_margin, 1e-6)
        self._zone = np.array([given.collision_zone, span])
        self._posture = model.comfortable()

    def one_frame(
        self, past: Array, rotation: Array, position: Array, proposed: Array, trust: float
    ) -> tuple[Array, float]:
        """The command for one target.

        Args:
            past: The last three commands (3, dof), oldest first.
            rotation, position: Of the target (1, 3, 3), (1, 3).
            proposed: A prior's joints (dof,).
            trust: Fraction of its weight that they have.

        Returns:
            The command (1, dof) and its cost after the first pass.
        """
        weights = self._one.copy()
        # What a trusted prior knows of the motion need not be guessed from its smoothness.
        weights[:JERK] *= 1.0 - trust
        x = past[2][None].copy()
        if trust > 0:
            x[0] = proposed
        cost = self._descend(
            x, past, rotation, position, weights, proposed[None], np.array([trust * self._prior])
        )
        self._descend(x, past, rotation, position, self._one_exact, x.copy(), np.array([self._exactness]))
        return x, cost

    def look_ahead(
        self,
        plan: Array | None,
        past: Array,
        rotations: Array,
        positions: Array,
        proposed: Array,
        trust: float,
    ) -> tuple[Array, float]:
        """A plan for the known targets, which goes on from the last one where that is the better beginning.

        Args:
            plan: The last plan (T, dof), whose first frame has been sent; None at the beginning.
            past, proposed, trust: As for one frame; a prior is heard in the first frame only.
            rotations, positions: Of the targets (T, 3, 3), (T, 3).

        Returns:
            The plan (T, dof) and its cost after the first pass.
        """
        frames = len(rotations)
        listen = np.zeros(frames)
        listen[0] = trust * self._prior
        heard = np.repeat(proposed[None], frames, axis=0)

        def descended(x: Array, iterations: int | None = None) -> float:
            costs = (self._ahead, heard, listen)
            return self._descend(x, past, rotations, positions, *costs, iterations=iterations)

        # What one frame after the other would do: no plan is worse than that by their common cost.
        nothing = np.zeros((0, self.model.dof))
        fresh = self._extended(past, nothing, rotations, positions, proposed, trust)
        if plan is None or len(plan) < 2:
            return self._exact(fresh, descended(fresh), past, rotations, positions)
        known = plan[1 : frames + 1].copy()
        keep_bounds(known, past[2], *self._bounds[:2], self._step)
        moved_on = self._extended(past, known, rotations, positions, proposed, trust)
        cost = descended(moved_on)
        if cost <= descended(fresh, iterations=0):
            return self._exact(moved_on, cost, past, rotations, positions)
        other = descended(fresh)
        best, cost = (fresh, other) if other < cost else (moved_on, cost)
        return self._exact(best, cost, past, rotations, positions)

    def _exact(
        self, x: Array, cost: float, past: Array, rotations: Array, positions: Array
    ) -> tuple[Array, float]:
        """The second pass over a plan of a known cost."""
        pull = np.full(len(x), self._ahead_exactness)
        self._descend(x, past, rotations, positions, self._ahead_exact, x.copy(), pull)
        return x, cost

    def _extended(
        self, past: Array, known: Array, rotations: Array, positions: Array, proposed: Array, trust: float
    ) -> Array:
        """A plan (T, dof) that begins with the known frames and goes on one frame at a time."""
        frames, kept = len(rotations), min(len(known), len(rotations))
        x = np.empty((frames, self.model.dof))
        x[:kept] = known[:kept]
        if self.terms:
            for t in range(kept, frames):
                row, history = slice(t, t + 1), np.concatenate([past, x[:t]])[-3:]
                x[t] = self.one_frame(history, rotations[row], positions[row], proposed, trust * (t == 0))[0][
                    0
                ]
            return x
        heard, listen = np.repeat(proposed[None], frames, axis=0), np.zeros(frames)
        listen[0] = trust * self._prior
        goal = (rotations, positions, self._task)
        weights = self._one.copy()
        weights[:JERK] *= 1.0 - trust * (kept == 0)
        first = (weights, self._posture, heard, listen, self._zone, NO_EXTRA)
        second = (self._one_exact, self._posture, heard, np.array([self._exactness]), self._zone, NO_EXTRA)
        one_after_the_other(
            x, kept, past, self._step, self.model.arrays, goal, first, second, self._bounds, self.settings.iterations,
            _DAMPING, _GAIN,
        )  # fmt: skip
        return x

    def _descend(
        self,
        x: Array,
        past: Array,
        rotations: Array,
        positions: Array,
        weights: Array,
        prior: Array,
        prior_weight: Array,
        iterations: int | None = None,
    ) -> float:
        """Improve the frames `x` (T, dof) in place; their cost."""
        most = self.settings.iterations if iterations is None else iterations
        if weights[COLLISION] and min(self.model.gap(frame)[0] for frame in x) > _FAR_APART:
            weights = weights.copy()
            weights[COLLISION] = 0.0
        model = self.model

        def improve(extra: Quadratic) -> tuple[float, Array]:
            costs = (weights, self._posture, prior, prior_weight, self._zone, extra)
            goal = (rotations, positions, self._task)
            cost, residuals, _ = descend(
                x, past, past[2], self._step, model.arrays, goal, costs, self._bounds, most, _DAMPING,
                _GAIN,
            )  # fmt: skip
            return cost, residuals

        if not self.terms:
            return improve(NO_EXTRA)[0]
        return descend_with_terms(x, self.terms, improve)[0]


def _constrained(settings: GuidanceSettings) -> int:
    """Number of axes of the tool that the task holds."""
    return sum(weight > 0 for weight in settings.task.weight)
