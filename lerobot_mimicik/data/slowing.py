"""Slowing a motion down where, and only where, an arm could not keep up with it.

Time is stretched locally: a frame interval in which some joint would move r times its limit takes r frame
times, and its neighbours a little more than one, so that speed falls and rises smoothly. The path itself
stays.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d, maximum_filter1d


def stretched_clock(q: np.ndarray, max_step: float, extra: np.ndarray | None = None) -> np.ndarray:
    """When, on the old clock, each frame of the new one happens.

    Args:
        q: Joints on an even clock [rad], shape (T, dof), T >= 2.
        max_step: Largest joint motion per frame [rad].
        extra: Further factor per frame, at least 1, shape (T,): an interval takes the larger one of its two
            ends.

    Returns:
        Increasing positions on the old frame axis, from 0 to T - 1, shape (T_new,), T_new >= T. Just the old
        frames if nothing is too fast.
    """
    steps = np.abs(np.diff(q, axis=0)).max(axis=1)
    needed = np.maximum(1.0, steps / max_step)
    if extra is not None:
        needed = needed * np.maximum(extra[:-1], extra[1:])
    if needed.max() <= 1.0:
        return np.arange(len(q), dtype=np.float64)
    # Widening before smoothing keeps the smoothed stretch above what is needed.
    stretch = np.maximum(
        needed, gaussian_filter1d(maximum_filter1d(needed, 5, mode="nearest"), 1.5, mode="nearest")
    )
    elapsed = np.concatenate([[0.0], np.cumsum(stretch)])
    frames = int(np.ceil(elapsed[-1] - 1e-9)) + 1
    inverse = PchipInterpolator(elapsed, np.arange(len(q)))
    clock = inverse(np.linspace(0.0, elapsed[-1], frames))
    clock[0], clock[-1] = 0.0, len(q) - 1.0  # not a rounding error beyond the ends
    return clock


def resample(pose: np.ndarray, q: np.ndarray, clock: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 7), quaternions of continuous sign, and joints (T, dof) at positions on their frame axis.

    By cubic splines; quaternions are normalised again. Shapes (T_new, 7) and (T_new, dof).
    """
    both = CubicSpline(np.arange(len(pose)), np.concatenate([pose, q], axis=1))(clock)
    both[:, 3:7] /= np.sqrt((both[:, 3:7] ** 2).sum(axis=1, keepdims=True))
    return both[:, :7], both[:, 7:]
