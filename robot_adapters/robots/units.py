"""Units of a robot's joints: radians, degrees, or -100 to 100 over each joint's range."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

UNITS = ("deg", "rad", "normalised")


class JointUnits:
    """A robot's numbers to rad and back, joint by joint; m where a joint slides and the unit is rad."""

    def __init__(self, unit: str, lower: ArrayLike | None = None, upper: ArrayLike | None = None) -> None:
        """`lower` and `upper` [rad] (dof,) are what -100 and 100 stand for, of `normalised` alone, in either order.

        Raises:
            ValueError: No such unit, or `normalised` without ranges.
        """
        self.unit = check_unit(unit)
        self._scale: Array = np.array(np.pi / 180 if unit == "deg" else 1.0)
        self._centre: Array = np.array(0.0)
        if unit == "normalised":
            if lower is None or upper is None:
                raise ValueError(
                    "joint_units='normalised' needs the joints' ranges, which this robot does not tell"
                )
            low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
            if not (np.isfinite(low).all() and np.isfinite(high).all() and (low != high).all()):
                raise ValueError(f"joint_units='normalised': expected finite ranges, got {low} to {high}")
            self._scale, self._centre = (high - low) / 200, (high + low) / 2

    def to_rad(self, values: ArrayLike) -> Array:
        """Numbers of the robot (dof,) in rad."""
        return np.asarray(values, dtype=float) * self._scale + self._centre

    def from_rad(self, q: ArrayLike) -> Array:
        """Joints [rad] (dof,) as the robot's numbers."""
        return (np.asarray(q, dtype=float) - self._centre) / self._scale


def check_unit(unit: str) -> str:
    """The unit itself; ValueError for one that is none."""
    if unit not in UNITS:
        raise ValueError(f"joint_units={unit!r}: expected one of {', '.join(UNITS)}")
    return unit
