"""Reference motions in joint space: minimum-jerk moves between configurations, free of collisions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array

_PEAK_RAD_S = 1.0  # half of the 0.1 rad per frame at 20 Hz from which a step counts as a spike
_PEAK_M_S = 0.25  # of a prismatic joint: a brisk hand
_SHORTEST_S = 0.5  # no move takes less
_LONGEST_REST_S = 0.4
_SPREAD_RAD = 0.35  # standard deviation of everyday configurations about home
_ATTEMPTS = 200


def everyday_motion(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> Array:
    """Joints (frames, dof) of moves between configurations about the home posture."""
    spread = np.minimum(_SPREAD_RAD, 0.2 * (arm.upper - arm.lower))

    def draw() -> Array:
        return np.clip(arm.home + rng.normal(size=arm.home.shape) * spread, arm.lower, arm.upper)

    return moves(arm, draw, frames, fps, rng)


def whole_workspace(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> Array:
    """Joints (frames, dof) of moves between configurations anywhere within the limits."""
    return moves(arm, lambda: rng.uniform(arm.lower, arm.upper), frames, fps, rng)


def moves(
    arm: ArmArrays,
    draw: Callable[[], Array],
    frames: int,
    fps: float,
    rng: np.random.Generator,
    start: Array | None = None,
) -> Array:
    """Joints (frames, dof) of minimum-jerk moves between drawn configurations, with short rests.

    Args:
        arm: The arm.
        draw: A configuration (dof,) each time it is called.
        frames: How many.
        fps: Frames per second.
        rng: For the pace.
        start: Where to begin, (dof,); None draws it.

    Raises:
        ValueError: If no move free of collisions is found.
    """
    here = _free_start(arm, draw) if start is None else start
    pieces = [here[None]]
    while sum(map(len, pieces)) < frames:
        for _ in range(_ATTEMPTS):
            piece = _move(arm, here, draw(), fps, rng)
            if arm.free(piece[1:]).all():
                break
        else:
            raise ValueError(f"no move from {here.round(3).tolist()} is free of collisions")
        here = piece[-1]
        pieces += [piece, np.tile(here, (int(rng.uniform(0, _LONGEST_REST_S) * fps), 1))]
    return np.concatenate(pieces)[:frames]


def eased(frames: int) -> Array:
    """The fraction of a minimum-jerk move that is done, (frames,), from above 0 to 1."""
    phase = np.arange(1, frames + 1) / frames
    return phase**3 * (10 - 15 * phase + 6 * phase**2)


def _move(arm: ArmArrays, start: Array, end: Array, fps: float, rng: np.random.Generator) -> Array:
    peak = np.where(arm.prismatic, _PEAK_M_S, _PEAK_RAD_S)
    # A minimum-jerk move peaks at 1.875 times its mean speed.
    seconds = max(_SHORTEST_S, float((1.875 * np.abs(end - start) / peak).max()) * rng.uniform(1.0, 1.3))
    return start + eased(round(seconds * fps))[:, None] * (end - start)


def _free_start(arm: ArmArrays, draw: Callable[[], Array]) -> Array:
    for _ in range(_ATTEMPTS):
        q = draw()
        if arm.free(q[None])[0]:
            return q
    raise ValueError("no configuration free of collisions was found within the joint limits")
