"""An arm as the compiled core sees it: plain arrays, and the scales that follow from its size."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance import kinematics_kernels
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.collision import ArmCollision
from lerobot_mimicik.kinematics.plausibility import joint_limits
from lerobot_mimicik.kinematics.point_chain import point_chain

Array = NDArray[np.float64]

_LEVER = 0.13
"""Metres per radian as a fraction of the reach: a tool turned by 1 rad counts like one moved by that far. 0.1 m on an
arm with 0.76 m of reach."""
_COLUMN = (
    0.25  # of the arm beyond the first joint: more of what lies before that joint does not count as reach
)
_SLIDE = 0.5
"""A sliding joint that moves by this fraction of the reach counts like one that turns by 1 rad."""


class ArmModel:
    """Kinematics, limits, scales and collision spheres of an arm.

    Attributes:
        description: The arm.
        lower, upper: Joint limits (dof,) [rad, m]; infinite for continuous joints.
        unit: (dof,), what makes a joint's motion comparable to one of 1 rad: 1 for joints that turn, 1/m for others.
        reach: Length of the stretched arm [m].
        lever: Metres that one radian of the tool counts as [m/rad].
        chain, spheres, pairs: Arrays for the compiled kinematics.
        arrays: These and `unit`, as `descent.descend` takes them.
        bodies: Names of the links, one per body, base first: what a collision names.
    """

    def __init__(self, description: ArmDescription) -> None:
        """ValueError and UrdfError as the description's chain."""
        self.description = description
        chain = array_chain(description)
        joints = description.joints()
        # Copies: the kernels are compiled for arrays that may be written.
        self.lower, self.upper = (bound.copy() for bound in joint_limits(description))
        arm = chain.stretched_length(1)
        # A column that the arm stands on is no part of it.
        self.reach = max(arm + min(chain.stretched_length(0) - arm, _COLUMN * arm), 1e-6)
        self.lever = _LEVER * self.reach
        sliding = np.array([joint.type == "prismatic" for joint in joints])
        self.unit = np.where(sliding, 1.0 / (_SLIDE * self.reach), 1.0)
        self.chain = (
            np.ascontiguousarray([rotation for rotation, _ in chain.steps], dtype=float),
            np.ascontiguousarray([position for _, position in chain.steps], dtype=float),
            np.array(chain.columns, dtype=np.int64),
            np.array(chain.prismatic, dtype=np.bool_),
            np.ascontiguousarray(chain.tool[0], dtype=float),
            np.ascontiguousarray(chain.tool[1], dtype=float),
        )
        self.bodies = _body_names(description)
        collision = ArmCollision(description, self.comfortable(), floor=None)
        self.spheres, self.pairs = collision.sphere_arrays()
        self.arrays = (self.chain, self.spheres, self.pairs, self.unit)
        self._points = point_chain(description)

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.lower)

    def comfortable(self) -> Array:
        """The description's home, or the middle of the joints' ranges, (dof,)."""
        if self.description.home:
            return np.array(self.description.home)
        middle = np.where(np.isfinite(self.lower + self.upper), (self.lower + self.upper) / 2, 0.0)
        return np.clip(middle, -np.pi, np.pi)

    def pose(self, q: Array) -> Array:
        """`T_base_tool` (7,) of joints (dof,)."""
        return self._points.pose(q)

    def gap(self, q: Array) -> tuple[float, int]:
        """Smallest gap between the arm's own bodies [m], infinite without shapes, and the number of that pair."""
        return kinematics_kernels.sphere_gap(q, self.chain, self.spheres, self.pairs)

    def pair_names(self, pair: int) -> tuple[str, str]:
        """Links of the bodies of a pair of spheres."""
        first, second = (int(self.spheres[2][sphere]) for sphere in self.pairs[pair])
        return self.bodies[first], self.bodies[second]

    def margins(self, width: float, fraction: float) -> Array:
        """How far from each limit a joint is kept clear of it, (dof,): `width` rad, or a `fraction` of the range."""
        span = self.upper - self.lower
        margin = np.minimum(width / self.unit, fraction * span)
        return np.where(np.isfinite(span), margin, 0.0)


@functools.lru_cache(maxsize=8)
def arm_model(description: ArmDescription) -> ArmModel:
    """The model of a description, built once per process."""
    return ArmModel(description)


def _body_names(description: ArmDescription) -> tuple[str, ...]:
    """The first link of every body, from the base on."""
    path: Any = description.chain()
    names = [path[0].parent]
    names += [joint.child for joint in path if joint.movable]
    return tuple(names)
