"""Leaving a branch of the inverse kinematics that a joint limit has closed.

Behind a singularity a motion may lead against a joint limit, while another configuration, on the other side of the
singularity, follows it without end. Going there takes the tool off its path for a moment; staying takes it off for as
long as the motion lasts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.search import closest_configuration
from lerobot_mimicik.guidance.settings import PoseTask
from lerobot_mimicik.kinematics.poses import pose_distance

Array = NDArray[np.float64]
_INWARDS = (0.4, 0.8, 1.6, 3.1)
"""rad from the limit, where a search begins; the last is half a turn, as where a wrist turns over."""
_SAMPLES = 11  # configurations looked at on the way


class BranchChange:
    """Finds the other configuration and keeps it on the target while the arm goes there.

    Attributes:
        goal: The configuration (dof,) [rad] that the arm is on the way to; None while no change is under way.
    """

    def __init__(
        self,
        model: ArmModel,
        task: PoseTask,
        is_reached: Callable[[Array, Array], bool],
        distance: float,
        detour: float,
        margin: float,
    ) -> None:
        """
        Args:
            model: The arm.
            task: Which part of a target counts.
            is_reached: Whether joints (dof,) meet a target (7,).
            distance: Largest joint motion of a change [rad]; 0 never changes.
            detour: How much further from the target than by staying the tool may come on the way [m].
            margin: Gap that the arm's own bodies keep on the way [m], where they have it now.
        """
        self._model, self._task, self._is_reached = model, task, is_reached
        self._distance, self._detour, self._margin = distance, detour, margin
        self.goal: Array | None = None
        self._asked = 0

    def cancel(self) -> None:
        """Stay in the present branch."""
        self.goal = None

    def look(self, q: Array, closest: Array, target: Array, upcoming: Array | None = None) -> Array | None:
        """A configuration that meets the target beyond the limit in the way, (dof,) [rad], if there is one.

        One search from another beginning each time it is called, so that it costs a controller little.

        Args:
            q: Present joints.
            closest: Where a descent from `q` ends, with joints at their limits if these are in the way.
            target: `T_base_tool` (7,).
            upcoming: Targets that follow it (T, 7), where they are known: the branch must meet the last as well.
        """
        model = self._model
        blocked = np.flatnonzero((closest <= model.lower) | (closest >= model.upper))
        if not blocked.size or self._distance <= 0:
            return None
        number, self._asked = self._asked, self._asked + 1
        joint = blocked[number // len(_INWARDS) % len(blocked)]
        inwards = _INWARDS[number % len(_INWARDS)]
        beginning = closest.copy()
        beginning[joint] += inwards if closest[joint] <= model.lower[joint] else -inwards
        found = closest_configuration(model, beginning, target, self._task)
        if not self._is_reached(found, target) or np.abs(found - q).max() > self._distance:
            return None
        if upcoming is not None and len(upcoming):
            later = closest_configuration(model, found, upcoming[-1], self._task)
            if not self._is_reached(later, upcoming[-1]):
                return None
        way = [q + (found - q) * fraction for fraction in np.linspace(0, 1, _SAMPLES)]
        staying = pose_distance(model.pose(closest), target)[0]
        if max(pose_distance(model.pose(point), target)[0] for point in way) > staying + self._detour:
            return None
        if len(model.pairs):
            least = min(self._margin, model.gap(q)[0])
            if min(model.gap(point)[0] for point in way) < least:
                return None
        self.goal, self._asked = found, 0
        return found

    def follow(self, target: Array) -> Array | None:
        """The goal moved along with the target; None, and the change is over, where it cannot follow."""
        if self.goal is not None:
            goal = closest_configuration(self._model, self.goal, target, self._task)
            self.goal = goal if self._is_reached(goal, target) else None
        return self.goal
