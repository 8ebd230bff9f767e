"""Leaving a branch of the inverse kinematics that a joint limit has closed.

Behind a singularity the motion asked for may lead against a joint limit, while another configuration, a small way
back through the singularity, follows it without end. Going there takes the tool off its path for a moment; staying
takes it off for as long as the motion lasts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.closest import closest_configuration
from lerobot_mimicik.kinematics.point_chain import PointChain
from lerobot_mimicik.kinematics.poses import pose_distance

Array = NDArray[np.float64]
_INWARDS = (0.4, 0.8)  # rad from the limit: where to begin the search
_SAMPLES = 11  # configurations looked at on the way


class BranchChange:
    """Finds the other configuration and keeps it on the target while the arm goes there.

    Attributes:
        goal: the configuration (dof,) [rad] that the arm is on the way to; None while no change is under way.
    """

    def __init__(
        self,
        chain: PointChain,
        lower: Array,
        upper: Array,
        is_reached: Callable[[tuple[float, float]], bool],
        distance: float,
        detour: float,
    ) -> None:
        """
        Args:
            chain: the arm.
            lower, upper: joint limits (dof,) [rad].
            is_reached: whether errors [m, rad] are those of a target that counts as met.
            distance: largest joint motion of a change [rad]; 0 never changes.
            detour: how much further from the target than by staying the tool may come on the way [m].
        """
        self._chain, self._lower, self._upper = chain, lower, upper
        self._is_reached, self._distance, self._detour = is_reached, distance, detour
        self.goal: Array | None = None
        self._asked = 0

    def cancel(self) -> None:
        """Stay in the present branch."""
        self.goal = None

    def look(self, q: Array, closest: Array, target: Array) -> Array | None:
        """A configuration beyond the limits' reach that meets the target, (dof,) [rad], if there is one.

        One search from another beginning each time it is called, so that it costs a controller little.

        Args:
            q: joints of now.
            closest: where a descent from `q` ends, with joints at their limits if these are in the way.
            target: `T_base_tool` (7,).
        """
        blocked = np.flatnonzero((closest <= self._lower) | (closest >= self._upper))
        if not blocked.size or self._distance <= 0:
            return None
        number, self._asked = self._asked, self._asked + 1
        joint = blocked[number // len(_INWARDS) % len(blocked)]
        inwards = _INWARDS[number % len(_INWARDS)]
        beginning = closest.copy()
        beginning[joint] += inwards if closest[joint] <= self._lower[joint] else -inwards
        found = closest_configuration(self._chain, self._lower, self._upper, beginning, target)
        if not self._meets(found, target) or np.abs(found - q).max() > self._distance:
            return None
        way = [q + (found - q) * share for share in np.linspace(0, 1, _SAMPLES)]
        furthest = max(pose_distance(self._chain.pose(point), target)[0] for point in way)
        if furthest > pose_distance(self._chain.pose(closest), target)[0] + self._detour:
            return None
        self.goal, self._asked = found, 0
        return found

    def follow(self, target: Array) -> Array | None:
        """The goal moved along with the target; None, and the change is over, where it cannot follow."""
        if self.goal is not None:
            goal = closest_configuration(self._chain, self._lower, self._upper, self.goal, target)
            self.goal = goal if self._meets(goal, target) else None
        return self.goal

    def _meets(self, q: Array, target: Array) -> bool:
        return self._is_reached(pose_distance(self._chain.pose(q), target))
