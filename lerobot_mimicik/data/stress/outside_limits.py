"""Starts outside the joint limits, as an arm that was pushed by hand has them."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion, moves

_OUTSIDE_RAD = (np.radians(0.5), np.radians(3.0))
_OUTSIDE_M = (1e-3, 5e-3)  # of a prismatic joint
_EPISODE_S = 4.0
_ATTEMPTS = 100


def outside_limits(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    """Short episodes that begin with one joint beyond a limit; the target leads away from there.

    Raises:
        ValueError: If no joint has a limit.
    """
    lower, upper = arm.limits
    limited = np.flatnonzero(np.isfinite(lower) & np.isfinite(upper))
    if not limited.size:
        raise ValueError("no joint of this arm has limits: there is no start outside them")
    length = min(frames, round(_EPISODE_S * fps))
    return [_start_outside(arm, limited, length, fps, rng) for _ in range(max(1, frames // length))]


def _start_outside(
    arm: ArmArrays, limited: np.ndarray, frames: int, fps: float, rng: np.random.Generator
) -> StressCase:
    for attempt in range(_ATTEMPTS):
        joint = int(rng.choice(limited))
        high = bool(rng.integers(2))
        start = everyday_motion(arm, 1, fps, rng)[0]
        start[joint] = arm.upper[joint] if high else arm.lower[joint]
        if arm.free(start[None])[0] or attempt == _ATTEMPTS - 1:
            break
    places = everyday_motion(arm, round(10 * fps), fps, rng)
    q = moves(arm, lambda: places[rng.integers(len(places))], frames + 1, fps, rng, start=start)
    case = StressCase.along(arm, q, "A start outside the joint limits")
    lower, upper = arm.limits
    excess = rng.uniform(*(_OUTSIDE_M if arm.prismatic[joint] else _OUTSIDE_RAD))
    case.state[0, joint] = upper[joint] + excess if high else lower[joint] - excess
    return case
