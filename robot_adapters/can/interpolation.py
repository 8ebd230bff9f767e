"""From targets at 20 to 50 Hz to a setpoint at every tick of the control loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SHORTEST, _LONGEST = 1 / 50, 1 / 20  # s between targets


class Interpolator:
    """A setpoint that moves in a straight line from where it is to the latest target, never faster than a
    limit.

    The line takes as long as targets are apart, so that the setpoint arrives when the next target comes.
    """

    def __init__(self, q: ArrayLike, max_velocity: float) -> None:
        """The setpoint rests at `q` [rad] (dof,); `max_velocity` [rad/s] binds every joint."""
        self._from = np.array(q, dtype=float)
        self.target = self._from.copy()
        self._max_velocity = max_velocity
        self._start, self._duration = 0.0, 0.0
        self._interval = _LONGEST
        self._last: float | None = None

    def aim(self, target: ArrayLike, now: float) -> None:
        """Take a new target [rad] (dof,) that came now [s]."""
        if self._last is not None:
            interval = min(max(now - self._last, _SHORTEST), _LONGEST)
            self._interval += 0.3 * (interval - self._interval)
        self._last = now
        self._go(np.array(target, dtype=float), now, self._interval)

    def settle(self, target: ArrayLike, now: float) -> None:
        """Go to a place [rad] (dof,) as fast as allowed and stay there."""
        self._last = None
        self._go(np.array(target, dtype=float), now, 0.0)

    def sample(self, now: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Setpoint [rad] and its velocity [rad/s], each (dof,)."""
        if self._duration <= 0 or now >= self._start + self._duration:
            return self.target.copy(), np.zeros_like(self.target)
        way = self.target - self._from
        return self._from + way * max(now - self._start, 0.0) / self._duration, way / self._duration

    def _go(self, target: NDArray[np.float64], now: float, duration: float) -> None:
        self._from, _ = self.sample(now)
        self.target, self._start = target, now
        farthest = float(np.max(np.abs(target - self._from), initial=0.0))
        self._duration = max(duration, farthest / self._max_velocity)
