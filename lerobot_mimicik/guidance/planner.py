"""One frame or several: the passes of descent that make a command, or a plan, of known targets.

A first pass weighs the pose against smoothness, clearance and a trusted prior. A second one starts from its answer and
is pulled to it only (iterated Tikhonov regularisation): what the first gave up of the pose comes back where the arm is
well conditioned, and stays given up where it is singular. Where the arm cannot serve every direction of the target, a
third pass meets the position alone and moves the joints as little as that takes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.descent import (
    COLLISION,
    JERK,
    POSTURE,
    descend,
    keep_bounds,
    one_after_the_other,
)
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.orientation import Service, service
from lerobot_mimicik.guidance.search import NO_EXTRA, KernelTask, kernel_task
from lerobot_mimicik.guidance.settings import GuidanceSettings, PoseTask
from lerobot_mimicik.guidance.user_terms import CostTerm, Quadratic, descend_with_terms

Array = NDArray[np.float64]

_DAMPING = 1e-2
"""Levenberg-Marquardt damping as a multiple of the squared pose residual (Sugihara 2011)."""
_GAIN = 1e-4  # fraction of its cost that a descent step must gain for another one to follow


_HELD = 1e-6
"""Weight that holds the joints in the third pass: it leaves a thousandth of the position error where the arm is well
conditioned, and all of it where the arm is stretched."""


_CLOSE, _STEEP = 0.2, 0.4
"""The zone in which bodies push each other apart in the second pass, and how fast that rises, as fractions of the
first pass's: a target that the margin allows is met."""
_APART = 0.1
"""Fraction of the weight of keeping bodies apart in the third pass; the gap itself is guarded afterwards."""
_FAR_APART = 0.06
"""Gap [m] from which bodies are not looked at while frames are improved; the command itself always is."""


class Planner:
    """Descends the costs of one arm; what it answers depends on its arguments only."""

    def __init__(
        self,
        model: ArmModel,
        settings: GuidanceSettings,
        terms: Sequence[CostTerm] = (),
        served: Service | None = None,
    ) -> None:
        """
        Args:
            model: The arm.
            settings: Weights and bounds.
            terms: Costs of the user's own.
            served: What the arm serves of the settings' task; None: find out.

        Raises:
            ValueError: The settings' posture has another number of joints than the arm.
        """
        served = served or service(model, settings)
        self.model, self.settings, self.terms = model, settings, tuple(terms)
        given, size, n = settings, model.reach**2, model.dof
        posture = given.posture * size if n > _constrained(served.task) else 0.0
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
        self._task = kernel_task(model, served.task)
        self._position = kernel_task(model, served.judged) if served.position_first else None
        self._held = size * _HELD
        self._placing = np.array([0.0, 0.0, 0.0, 0.0, 0.0, _APART * collision])
        self._spare = given.posture * size
        self._bounds = (
            model.lower,
            model.upper,
            model.margins(given.clearance_width, given.clearance_fraction),
        )
        self._step = np.full(n, given.max_step)
        span = max(given.collision_zone - given.collision_margin, 1e-6)
        self._zone = np.array([given.collision_zone, span])
        # What the first pass keeps away from without need, the second may use, up to close before the margin.
        self._exact_zone = np.array([given.collision_margin + _CLOSE * span, _STEEP * span])
        self._posture = np.array(given.posture_joints) if given.posture_joints else model.comfortable()
        if len(self._posture) != n:
            names = ", ".join(model.description.joint_names)
            raise ValueError(f"posture_joints: expected {n} joints ({names}), got {len(self._posture)}")

    def one_frame(
        self,
        past: Array,
        rotation: Array,
        position: Array,
        proposed: Array,
        trust: float,
        turning: float = 1.0,
    ) -> tuple[Array, float]:
        """The command for one target.

        Args:
            past: The last three commands (3, dof), oldest first.
            rotation, position: Of the target (1, 3, 3), (1, 3).
            proposed: A prior's joints (dof,).
            trust: Fraction of its weight that they have.
            turning: Fraction of its weight that the orientation has; what it does not hold, the posture does.

        Returns:
            The command (1, dof) and its cost after the first pass.
        """
        weights, task = self._eased(self._one, turning)
        # What a trusted prior knows of the motion need not be guessed from its smoothness.
        weights[:JERK] *= 1.0 - trust
        x = past[2][None].copy()
        if trust > 0:
            x[0] = proposed
        cost = self._descend(
            x, past, rotation, position, weights, proposed[None], np.array([trust * self._prior]), task=task
        )
        pull = np.array([self._exactness])
        self._descend(
            x, past, rotation, position, self._one_exact, x.copy(), pull, task=task, zone=self._exact_zone
        )
        self._place(x, past, rotation, position)
        return x, cost

    def look_ahead(
        self,
        plan: Array | None,
        past: Array,
        rotations: Array,
        positions: Array,
        proposed: Array,
        trust: float,
        turning: float = 1.0,
    ) -> tuple[Array, float]:
        """A plan for the known targets, which goes on from the last one where that is the better beginning.

        Args:
            plan: The last plan (T, dof), whose first frame has been sent; None at the beginning.
            past, proposed, trust, turning: As for one frame; a prior is heard in the first frame only.
            rotations, positions: Of the targets (T, 3, 3), (T, 3).

        Returns:
            The plan (T, dof) and its cost after the first pass.
        """
        frames = len(rotations)
        listen = np.zeros(frames)
        listen[0] = trust * self._prior
        heard = np.repeat(proposed[None], frames, axis=0)
        weights, task = self._eased(self._ahead, turning)

        def descended(x: Array, iterations: int | None = None) -> float:
            costs = (weights, heard, listen)
            return self._descend(x, past, rotations, positions, *costs, iterations=iterations, task=task)

        def exact(x: Array, cost: float) -> tuple[Array, float]:
            return self._exact(x, cost, past, rotations, positions, task)

        # What one frame after the other would do: no plan is worse than that by their common cost.
        nothing = np.zeros((0, self.model.dof))
        fresh = self._extended(past, nothing, rotations, positions, proposed, trust, turning)
        if plan is None or len(plan) < 2:
            return exact(fresh, descended(fresh))
        known = plan[1 : frames + 1].copy()
        keep_bounds(known, past[2], *self._bounds[:2], self._step)
        moved_on = self._extended(past, known, rotations, positions, proposed, trust, turning)
        cost = descended(moved_on)
        if cost <= descended(fresh, iterations=0):
            return exact(moved_on, cost)
        other = descended(fresh)
        best, cost = (fresh, other) if other < cost else (moved_on, cost)
        return exact(best, cost)

    def _exact(
        self, x: Array, cost: float, past: Array, rotations: Array, positions: Array, task: KernelTask
    ) -> tuple[Array, float]:
        """The second pass over a plan of a known cost."""
        pull = np.full(len(x), self._ahead_exactness)
        self._descend(
            x, past, rotations, positions, self._ahead_exact, x.copy(), pull, task=task, zone=self._exact_zone
        )
        self._place(x, past, rotations, positions)
        return x, cost

    def _place(self, x: Array, past: Array, rotations: Array, positions: Array) -> None:
        """The third pass over frames (T, dof), in place: positions first."""
        if self._position is None:
            return
        pull = np.full(len(x), self._held)
        self._descend(
            x,
            past,
            rotations,
            positions,
            self._placing,
            x.copy(),
            pull,
            task=self._position,
            zone=self._exact_zone,
        )

    def _eased(self, weights: Array, turning: float) -> tuple[Array, KernelTask]:
        """Weights and task, copies, with the orientation at a fraction of its weight."""
        weights, task = weights.copy(), self._task
        if turning < 1.0:
            weights[POSTURE] += (1.0 - turning) * self._spare
            task = (task[0] * np.repeat([1.0, turning], 3), *task[1:])
        return weights, task

    def _extended(
        self,
        past: Array,
        known: Array,
        rotations: Array,
        positions: Array,
        proposed: Array,
        trust: float,
        turning: float,
    ) -> Array:
        """A plan (T, dof) that begins with the known frames and goes on one frame at a time."""
        frames, kept = len(rotations), min(len(known), len(rotations))
        x = np.empty((frames, self.model.dof))
        x[:kept] = known[:kept]
        if self.terms:
            for t in range(kept, frames):
                row, history = slice(t, t + 1), np.concatenate([past, x[:t]])[-3:]
                x[t] = self.one_frame(
                    history, rotations[row], positions[row], proposed, trust * (t == 0), turning
                )[0][0]
            return x
        heard, listen = np.repeat(proposed[None], frames, axis=0), np.zeros(frames)
        listen[0] = trust * self._prior
        weights, task = self._eased(self._one, turning)
        goal = (rotations, positions, task)
        weights[:JERK] *= 1.0 - trust * (kept == 0)
        first = (weights, self._posture, heard, listen, self._zone, NO_EXTRA)
        second = (
            self._one_exact,
            self._posture,
            heard,
            np.array([self._exactness]),
            self._exact_zone,
            NO_EXTRA,
        )
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
        task: KernelTask | None = None,
        zone: Array | None = None,
    ) -> float:
        """Improve the frames `x` (T, dof) in place; their cost."""
        most = self.settings.iterations if iterations is None else iterations
        if weights[COLLISION] and min(self.model.gap(frame)[0] for frame in x) > _FAR_APART:
            weights = weights.copy()
            weights[COLLISION] = 0.0
        model = self.model

        def improve(extra: Quadratic) -> tuple[float, Array]:
            costs = (weights, self._posture, prior, prior_weight, self._zone if zone is None else zone, extra)
            goal = (rotations, positions, task or self._task)
            cost, residuals, _ = descend(
                x, past, past[2], self._step, model.arrays, goal, costs, self._bounds, most, _DAMPING,
                _GAIN,
            )  # fmt: skip
            return cost, residuals

        if not self.terms:
            return improve(NO_EXTRA)[0]
        return descend_with_terms(x, self.terms, improve)[0]


def _constrained(task: PoseTask) -> int:
    """Number of axes of the tool that the task holds."""
    return sum(weight > 0 for weight in task.weight) - (1 if any(task.axis) else 0)
