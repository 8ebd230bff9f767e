"""The guided solver: a target and what is known of the next ones in, a bounded command with its certificate out.

                    ┌ one frame: two passes (regularised, then exact) ┐
target, upcoming ──>┤                                                  ├─> clear of itself ──> command, certificate
  prior (a network) └ a plan: two passes over all known frames         ┘
                      where it does not meet the target: closest configuration, change of branch

Every command keeps the joint limits and the step bound exactly, whatever the costs say. The answer depends on the
calls since `reset` only, and no call takes more than a fixed number of steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.blending import Blending
from lerobot_mimicik.guidance.branches import BranchChange
from lerobot_mimicik.guidance.certificate import (
    Certificate,
    Reason,
    at_limits,
    is_singular,
    smallest_singular,
)
from lerobot_mimicik.guidance.compilation import announce_compilation
from lerobot_mimicik.guidance.descent import keep_bounds
from lerobot_mimicik.guidance.kinematics_kernels import judge, split_poses
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.orientation import free_axis, service, unserved_turn, within_leash
from lerobot_mimicik.guidance.planner import Planner
from lerobot_mimicik.guidance.search import closest_configuration, kernel_task
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.guidance.steadying import Foresees, steadied
from lerobot_mimicik.guidance.user_terms import CostTerm

Array = NDArray[np.float64]

_TRUSTED_M = 1e-3
"""Residual [m] of a prior's own command at which half of its weight is lost."""
_PROGRESS = 0.5  # fraction of the way to the target that a trusted prior's command leaves, at most
_MET = 5e-5  # m: a position that is off by more makes the orientation give way, where it comes second
_TURN_BACK = 0.05  # of its weight that the orientation gets back in a frame that meets the position
_FOLLOWED = 0.1  # rad: an orientation that is off by less, where the arm can turn its tool, is being followed
_TURN_AWAY, _LEAST_TURNING = 0.93, 0.1  # what is left of its weight a frame otherwise, and at least
_GUARD_HALVINGS = 12  # of the way from a start that is clear to a command that is not


_AT_REST = 1e-3  # rad; a command that moves no joint further has come to rest
_Why = tuple[Reason, tuple[str, ...], tuple[str, str] | None, tuple[float, float] | None]
"""Reason, joints and links in the way, errors of the closest configuration."""


class Prior(Protocol):
    """Proposes joints; guidance decides how far it listens."""

    def __call__(self, start: Array, target: Array) -> Array:
        """Proposed joints (dof,) for a target (7,) from joints (dof,)."""


@dataclass(frozen=True)
class Solution:
    """The answer to one target.

    Attributes:
        q: Command (dof,) [rad, m].
        certificate: Whether and why it meets the target.
        plan: Planned joints (T, dof) from this frame on; one row without look-ahead.
        cost: The shared cost of the plan.
        trust: Fraction of the prior's weight that it earned in this frame.
        changing: Whether the arm is on the way to another branch.
        kept_apart: The two links that would come closer than allowed in some frame of the plan, which was therefore
            changed; None where there are none.
    """

    q: Array
    certificate: Certificate
    plan: Array
    cost: float
    trust: float
    changing: bool
    kept_apart: tuple[str, str] | None = None


class Guidance:
    """Guides one arm from command to command.

    Attributes:
        model: The arm.
        settings: Weights, bounds and tolerances.
        terms: Costs of the user's own.
        served: What the arm serves of a target.
        foresight: Makes trembling targets steady where the next ones are not known; None leaves them as they are.
    """

    def __init__(
        self,
        model: ArmModel,
        settings: GuidanceSettings | None = None,
        terms: Sequence[CostTerm] = (),
        foresight: Foresees | None = None,
    ) -> None:
        announce_compilation()
        self.foresight = foresight
        self.model, self.settings, self.terms = model, settings or GuidanceSettings(), tuple(terms)
        given = self.settings
        self.served = service(model, given)
        self._planner = Planner(model, given, terms, self.served)
        self._judged = self.served.judged
        self._task = kernel_task(model, self._judged)
        self._step = np.full(model.dof, given.max_step)
        self._branch = BranchChange(
            model,
            self._judged,
            self.meets,
            given.branch_distance,
            given.branch_detour,
            given.collision_margin,
        )
        self._blending = Blending(given.blend, model.lever, model.reach)
        self._past: Array | None = None
        self._plan: Array | None = None
        self._turning = 1.0  # fraction of its weight that the orientation has, where the position comes first

    def reset(self, q: Array) -> None:
        """Forget the past: the arm is at rest at `q` (dof,)."""
        self._past = np.stack([np.asarray(q, dtype=float)] * 3)
        self._plan, self._turning = None, 1.0
        self._branch.cancel()
        self._blending.reset()
        if self.foresight is not None:
            self.foresight.reset(self._past[2])

    def commanded(self, q: Array) -> None:
        """Say that `q` (dof,) was sent in place of the last command; where it is that command, the plan stays."""
        if self._past is not None and not np.array_equal(q, self._past[2]):
            self._past[2] = q
            self._plan = None

    def meets(self, q: Array, target: Array) -> bool:
        """Whether joints (dof,) meet a target (7,) within the tolerances, the task's axes and tolerances counted."""
        return self._reached(self._left_over(q, target))

    def solve(
        self, start: Array, target: Array, upcoming: Array | None = None, prior: Callable | None = None
    ) -> Solution:
        """The next command.

        Args:
            start: Joints that the step starts from (dof,), the last command or the measured joints.
            target: `T_base_tool` (7,), unit quaternion.
            upcoming: Targets of the frames after it (T, 7), as many as are known.
            prior: Proposes joints for the target; trusted as far as it earns it.
        """
        past = self._remember(start)
        targets = target[None]
        if upcoming is not None and len(upcoming):
            targets = np.concatenate([targets, upcoming[: self.settings.horizon - 1]])
        targets = self._blending(targets)
        goal = self._branch.follow(target)
        if goal is not None:
            return self._on_the_way(past, goal, target)
        if self.foresight is not None and len(targets) == 1:
            targets = steadied(self.foresight, self.model, self.settings, past[2], targets[0])[None]
        aim = targets[0]
        rotations, positions = split_poses(targets)
        if self.served.position_first:
            rotations = within_leash(self.model, past[2], rotations)
        proposed, trust = self._trusted(past[2], aim, prior)
        plan, cost = self._planned(past, rotations, positions, proposed, trust, aim)
        kept = self._plan_kept_clear(past[2], plan)
        self._plan = plan if len(targets) > 1 else None
        q = plan[0]
        source = "prior" if trust > 0.5 else "guided"
        certificate = self._certify(past[2], q, target, source)
        if (
            not certificate.reached
            and certificate.closest is not None
            and not self._reached_errors(certificate)
        ):
            closest = closest_configuration(self.model, past[2], target, self._judged)
            goal = self._branch.look(past[2], closest, target, upcoming)
            if goal is not None:
                return self._on_the_way(past, goal, target)
        return self._remembered(past, Solution(q, certificate, plan, cost, trust, False, kept))

    def _planned(
        self, past: Array, rotations: Array, positions: Array, proposed: Array, trust: float, target: Array
    ) -> tuple[Array, float]:
        """The plan (T, dof) for known targets and its cost; an orientation that costs the position gives way."""

        def planned(turning: float) -> tuple[Array, float]:
            if len(rotations) == 1:
                return self._planner.one_frame(past, rotations, positions, proposed, trust, turning)
            return self._planner.look_ahead(self._plan, past, rotations, positions, proposed, trust, turning)

        if not self.served.position_first:
            return planned(1.0)
        plan, cost = planned(self._turning)
        missed = math.hypot(*self._left_over(plan[0], target)[:3])
        if missed <= _MET:
            if unserved_turn(self.model, plan[0], rotations[0]) < _FOLLOWED:
                self._turning = min(1.0, self._turning + _TURN_BACK)
            else:
                # Out of the joints' limits or still far: what pulls for long must not fold the arm up against them.
                self._turning = max(_LEAST_TURNING, _TURN_AWAY * self._turning)
            return plan, cost
        self._turning *= 0.5
        other = planned(0.0)
        return other if math.hypot(*self._left_over(other[0][0], target)[:3]) < missed else (plan, cost)

    # ---- prior --------------------------------------------------------------------------------------------------

    def _trusted(self, start: Array, target: Array, prior: Callable | None) -> tuple[Array, float]:
        """The prior's command within the bounds, and the fraction of its weight that it earns.

        It earns it by how well its own command meets the target: fully where it is met, half at a millimetre, and not at
        all where the command leaves more than half of the way that the arm has to go.
        """
        if prior is None:
            return start, 0.0
        proposed = np.asarray(prior(start.copy(), target.copy()), dtype=float)[None].copy()
        keep_bounds(proposed, start, self.model.lower, self.model.upper, self._step)
        scale = self._task[0]
        left = float(np.linalg.norm(scale * self._left_over(proposed[0], target)))
        way = float(np.linalg.norm(scale * self._left_over(start, target)))
        if not left < _PROGRESS * way:
            return start, 0.0
        return proposed[0], (1.0 - left / (_PROGRESS * way)) / (1.0 + (left / _TRUSTED_M) ** 2)

    # ---- collision ----------------------------------------------------------------------------------------------

    def _plan_kept_clear(self, start: Array, plan: Array) -> tuple[str, str] | None:
        """Change the frames (T, dof) so that each keeps clear, and a step from the one before; the links in the way."""
        links = None
        model = self.model
        if not len(model.pairs):
            return None
        for t, planned in enumerate(plan):
            before = plan[t - 1] if t else start
            if links is not None:
                keep_bounds(plan[t : t + 1], before, model.lower, model.upper, self._step)
            kept = self._kept_clear(before, planned)
            if kept is not planned:
                links = links or model.pair_names(model.gap(planned)[1])
                plan[t] = kept
        return links

    def _kept_clear(self, start: Array, q: Array) -> Array:
        """The command, or the furthest point on the way to it that keeps the gap between the arm's own bodies.

        Kept is the margin, or the gap at the start where that is smaller; the start itself always keeps it.
        """
        model = self.model
        if not len(model.pairs):
            return q
        gap = model.gap(q)[0]
        margin = self.settings.collision_margin
        if gap >= margin:
            return q
        least = min(margin, model.gap(start)[0])
        if gap >= least:
            return q
        kept, low, high = start.copy(), 0.0, 1.0
        for _ in range(_GUARD_HALVINGS):
            middle = 0.5 * (low + high)
            point = start + middle * (q - start)
            if model.gap(point)[0] >= least:
                kept, low = point, middle
            else:
                high = middle
        return kept

    # ---- certificate --------------------------------------------------------------------------------------------

    def _left_over(self, q: Array, target: Array) -> Array:
        """Pose error (6,) [m, rad] beyond the task's tolerances on its axes; 0 on free ones."""
        return judge(q, target, self.model.chain, *self._task)[0]

    def _reached(self, left: Array) -> bool:
        given = self.settings
        return (
            math.hypot(*left[:3]) <= given.position_tolerance
            and math.hypot(*left[3:]) <= given.rotation_tolerance
        )

    def _reached_errors(self, certificate: Certificate) -> bool:
        """Whether the closest configuration meets the target."""
        return certificate.reason in (Reason.STEP, Reason.SMOOTHNESS, Reason.COLLISION)

    def _certify(self, start: Array, q: Array, target: Array, source: str) -> Certificate:
        model = self.model
        left, position_error, rotation_error = judge(q, target, model.chain, *self._task)
        reached = self._reached(left)
        gap, pair = model.gap(q)
        margin = float(np.minimum(q - model.lower, model.upper - q).min())
        why: _Why = (Reason.NONE, (), None, None) if reached else self._why(start, q, target, pair, gap)
        reason, names, bodies, closest = why
        value = smallest_singular(model, q)[0] if not reached else np.nan
        free = None
        if self.served.position_first and rotation_error > self.settings.rotation_tolerance:
            axis = free_axis(model, q)
            free = None if axis is None else (float(axis[0]), float(axis[1]), float(axis[2]))
        return Certificate(
            reached, reason, names, bodies, position_error, rotation_error, tuple(left.tolist()), closest, margin,
            gap, value, source, free,
        )  # fmt: skip

    def _why(self, start: Array, q: Array, target: Array, pair: int, gap: float) -> _Why:
        model, joints = self.model, self.model.description.joint_names
        there = closest_configuration(model, start, target, self._judged)
        closest = self._errors(there, target)
        bound = np.abs(q - start) >= self.settings.max_step * (1 - 1e-6)
        # Collisions are the reason where the arm is as close to itself as it may come.
        near = gap < self.settings.collision_margin + 1e-4 or (
            len(model.pairs) and model.gap(there)[0] < self.settings.collision_margin
        )
        if self.meets(there, target):
            if near:
                number = pair if gap < self.settings.collision_margin + 1e-4 else model.gap(there)[1]
                return Reason.COLLISION, (), model.pair_names(number), closest
            step = float(np.abs(q - start).max())
            if step < _AT_REST and gap < self.settings.collision_zone and self.settings.collision > 0:
                # The arm has come to rest where its bodies push each other apart.
                return Reason.COLLISION, (), model.pair_names(pair), closest
            if bound.any() or np.abs(there - start).max() > self.settings.max_step:
                return Reason.STEP, tuple(np.array(joints)[bound]), None, closest
            return Reason.SMOOTHNESS, (), None, closest
        limited = at_limits(model, there)
        if limited.any():
            return Reason.LIMIT, tuple(np.array(joints)[limited]), None, closest
        if is_singular(model, there, self._left_over(there, target)):
            return Reason.SINGULAR, (), None, closest
        return Reason.REACH, (), None, closest

    def _errors(self, q: Array, target: Array) -> tuple[float, float]:
        """Errors of joints (dof,) against a target (7,), tolerances not counted [m, rad]."""
        return judge(q, target, self.model.chain, *self._task)[1:]

    # ---- memory -------------------------------------------------------------------------------------------------

    def _remember(self, start: Array) -> Array:
        """The last three commands (3, dof), the last one `start`: moved along where the arm was elsewhere."""
        if self._past is None:
            self.reset(start)
        assert self._past is not None
        if np.array_equal(self._past[2], start):
            return self._past
        return self._past + (start - self._past[2])

    def _remembered(self, past: Array, solution: Solution) -> Solution:
        self._past = np.concatenate([past[1:], solution.q[None]])
        return solution

    def _on_the_way(self, past: Array, goal: Array, target: Array) -> Solution:
        start = past[2]
        step = np.abs(goal - start) / self._step
        q = goal if step.max() <= 1 else start + (goal - start) / step.max()
        q = self._kept_clear(start, q)
        if step.max() <= 1:
            self._branch.cancel()
        self._plan = None
        found = self._certify(start, q, target, "branch")
        # History lies in the branch that is being left: the arm begins anew at every frame of the way.
        solution = Solution(q, found, q[None], np.nan, 0.0, True)
        self._past = np.stack([q] * 3)
        if self.foresight is not None:
            self.foresight.reset(q)
        return solution
