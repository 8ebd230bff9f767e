"""The G2 gripper's slider-crank: opening between the fingers against the motor's angle."""

from __future__ import annotations

import math

_CRANK, _ROD, _OFFSET = 0.022, 0.036, 0.01722  # m
_CLOSED_ANGLE = 2.3190538837099055  # rad, crank angle at motor angle 0
MAX_OPENING = 0.07  # m, as far as public logs open it
GRIPPER_KP, GRIPPER_KD = 30.0, 1.5  # Nm/rad, Nm s/rad: the vendor's joint-following mode


def opening_from_motor_angle(angle: float) -> float:
    """Opening [m] at a motor angle [rad]; 0 at angle 0, where the gripper is closed.

    opening = 2 (L1 cos theta + sqrt(L2^2 - L1^2 sin^2 theta) - L3), theta = theta_closed + angle. Opening
    turns the motor towards negative angles.
    """
    theta = _CLOSED_ANGLE + angle
    return 2.0 * (_CRANK * math.cos(theta) + math.sqrt(_ROD**2 - (_CRANK * math.sin(theta)) ** 2) - _OFFSET)


def motor_angle_from_opening(opening: float) -> float:
    """Motor angle [rad] at an opening [m], the inverse of `opening_from_motor_angle`.

    By the law of cosines on the crank, the rod and the slider. The opening is clamped to what the mechanism
    reaches, [0, 2 (L1 + L2 - L3)]; ValueError when it is not a finite number.
    """
    if not math.isfinite(opening):
        raise ValueError(f"the gripper's opening must be a finite number of metres, got {opening}")
    slider = min(max(opening, 0.0) / 2.0 + _OFFSET, _CRANK + _ROD)
    cosine = (slider**2 + _CRANK**2 - _ROD**2) / (2.0 * slider * _CRANK)
    return math.acos(min(max(cosine, -1.0), 1.0)) - _CLOSED_ANGLE
