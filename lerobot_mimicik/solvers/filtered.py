"""The guided solver behind classic filters of the target: what a trembling hand is usually given.

- Low-pass: Butterworth of second order, causal, on positions and quaternion.
- One-Euro (Casiez, Roussel & Vogel 2012): a first-order low-pass whose cut-off grows with the speed.
- Kalman filter of constant acceleration, stationary gains: each axis apart, driven by white jerk, measured with a
  noise of 1 mm (0.5 degrees) along three axes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import butter, lfilter, lfilter_zi

from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.guided import GuidedSolver

_FPS = 20.0  # Hz: solvers are not told the frame rate; that of the paper and of the stress sets
_NOISE_MM = 1.0 / np.sqrt(3.0)  # per axis

Filter = Callable[[Array], Array]
"""Takes one frame's numbers (7,) after another, the first one being where all rests."""


class LowPass:
    """Causal Butterworth low-pass of second order."""

    def __init__(self, cutoff_hz: float) -> None:
        self._b, self._a = butter(2, cutoff_hz, fs=_FPS)
        self._state: Array | None = None

    def __call__(self, pose: Array) -> Array:
        if self._state is None:
            self._state = lfilter_zi(self._b, self._a)[:, None] * pose
        out, self._state = lfilter(self._b, self._a, pose[None], axis=0, zi=self._state)
        return out[0]


class OneEuro:
    """First-order low-pass whose cut-off is `cutoff_hz` plus `beta` times the speed, [1/s] of positions in m."""

    def __init__(self, cutoff_hz: float, beta: float) -> None:
        self._cutoff, self._beta = cutoff_hz, beta
        self._last: Array | None = None

    def __call__(self, pose: Array) -> Array:
        if self._last is None:
            self._last, self._raw, self._rate = pose.copy(), pose.copy(), np.zeros(7)
        self._rate = self._rate + _smoothing(1.0) * ((pose - self._raw) * _FPS - self._rate)
        self._raw = pose.copy()
        speeds = np.repeat([np.linalg.norm(self._rate[:3]), np.linalg.norm(self._rate[3:])], [3, 4])
        self._last = self._last + _smoothing(self._cutoff + self._beta * speeds) * (pose - self._last)
        return self._last


class Kalman:
    """Kalman filter of constant acceleration; `jerk_mm` is what changes it, per axis [mm/frame^3]."""

    def __init__(self, jerk_mm: float) -> None:
        self._move = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
        drive = np.array([1.0 / 6.0, 0.5, 1.0])
        # In mm and in quaternion units alike: what counts is the ratio of drive and noise.
        ahead = solve_discrete_are(
            self._move.T, np.eye(3)[:, :1], jerk_mm**2 * np.outer(drive, drive), np.array([[_NOISE_MM**2]])
        )
        self._gain = ahead[:, 0] / (ahead[0, 0] + _NOISE_MM**2)
        self._state: Array | None = None

    def __call__(self, pose: Array) -> Array:
        if self._state is None:
            self._state = np.concatenate([pose[None], np.zeros((2, 7))])
        self._state = self._move @ self._state
        self._state = self._state + self._gain[:, None] * (pose - self._state[0])
        return self._state[0]


def _smoothing(cutoff_hz: Any) -> Any:
    """Weight of the new value in a first-order low-pass."""
    angle = 2.0 * np.pi * cutoff_hz / _FPS
    return angle / (angle + 1.0)


class FilteredSolver(GuidedSolver):
    """The guided solver, asked for filtered targets."""

    _make: Callable[[], Filter]
    _filter: Filter | None = None
    _sign: Array | None = None

    def reset(self, q: Array) -> None:
        """The arm is at rest at `q` (dof,); the filter begins with the next target."""
        super().reset(q)
        self._filter = self._sign = None

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) for the filtered target."""
        pose = target_pose.copy()
        if self._sign is not None and pose[3:] @ self._sign < 0:
            pose[3:] *= -1.0  # q and -q are one rotation, but not to a filter
        self._sign = pose[3:].copy()
        if self._filter is None:
            self._filter = type(self)._make()
        smooth = self._filter(pose)
        rotation = smooth[3:] / np.linalg.norm(smooth[3:])
        return super().solve(
            q_curr, np.concatenate([smooth[:3], rotation if rotation[3] >= 0 else -rotation])
        )


def _register(name: str, make: Callable[[], Filter], what: str) -> None:
    kind = type(
        "FilteredSolver",
        (FilteredSolver,),
        {
            "__module__": __name__,
            "name": name,
            "configuration": f"The row guided behind {what}",
            "_make": staticmethod(make),
        },
    )
    register_solver(name)(kind)


for _hz in (3.0, 4.5, 6.0):
    _register(f"guided_lowpass_{_hz:g}", partial(LowPass, _hz), f"a Butterworth low-pass of {_hz:g} Hz")
_register("guided_one_euro", lambda: OneEuro(1.5, 15.0), "a One-Euro filter, 1.5 Hz and 15 Hz s/m")
for _jerk in (0.03, 0.3):
    _register(
        f"guided_kalman_{_jerk:g}",
        partial(Kalman, _jerk),
        f"a Kalman filter of constant acceleration, {_jerk:g} mm/frame^3",
    )
