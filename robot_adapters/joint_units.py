"""Radians or degrees: the unit of a robot's joints in processor steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import check_plausible


def check_rad_or_deg(joint_units: str) -> None:
    """ValueError unless it is `rad` or `deg`."""
    if joint_units not in ("rad", "deg"):
        raise ValueError(
            f"joint_units={joint_units!r}: expected 'rad' or 'deg', the unit of the robot's joints (airbot_play: "
            "rad; most of LeRobot's robots: deg)"
        )


def to_rad(joint_units: str) -> float:
    """What joints in that unit are multiplied with to be in rad."""
    return np.pi / 180 if joint_units == "deg" else 1.0


def check_joints(description: ArmDescription, joints: NDArray[np.float64], joint_units: str) -> None:
    """ValueError for joints (..., dof) [rad] that are none of this arm, which says what to try."""
    remedy = f"joint_units is {joint_units!r}; set it to the unit of the robot, 'rad' or 'deg'"
    check_plausible(description, joints, what="the measured joints", joints_remedy=remedy)
