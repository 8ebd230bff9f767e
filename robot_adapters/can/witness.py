"""What contradicts a motor's feedback: its range, its own velocity, its torque and the commands it was given.

`MotionWitness` judges the frames of one motor by themselves: an angle must lie in the joint's mechanical
range, be within reach of the angle before it, and change as the reported velocity says. `TorqueWitness` judges
the joints of an arm against its commands: a motor under the MIT law gives the torque

    torque = kp (p - q) + kd (v - dq) + feed-forward

so angle, velocity and torque together tell the command (p, v) that the motor acts on, whatever the joint
carries, meets or rubs against. That command must be the one sent, up to the motor's lag. On logs of a real arm
at up to 1.6 rad/s the two agree within 0.04 rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

# An angle is believed at once within this of the last one [rad], and what both velocities explain.
_JUMP = 0.05
# Beyond that and within this speed [rad/s] of the last one (twice the fastest command) several frames must agree.
_SPEED, _AGREEING = 4.0, 3
# Frames in a row that agree on what cannot be (20 ms at 250 Hz: a motor whose zero has moved drives its joint all
# that time), and that differ from velocity or torque (32 ms). Damaged frames do not agree with each other.
_IMPOSSIBLE, _LASTING = 5, 8
# After a frame that comes later than this [s] after the one before, or several that come sooner, any reading of the
# next half second may be late by a quarter of a second.
_SHORTEST, _LONGEST = 0.0005, 0.010
_UNSTEADY_FOR, _LATE = 0.5, 0.25
# Angle against integrated velocity: memory [s], difference allowed [rad] and fraction of the way travelled. Real
# logs differ by a tenth of (0.05 rad + the way).
_MEMORY, _DRIFT, _DRIFT_FRACTION = 1.0, 0.04, 0.15
# From one frame to the next, a velocity that changes by more [rad/s] or an angle that differs from it by more
# [rad] belongs to a damaged frame, and says nothing of what lasts.
_DAMAGED, _JOLT = 3.0, 0.02
# Time constant [s] of each of the motor's two first-order lags: none (a bare MIT motor), the vendor's
# joint-following mode with its dead time, and what lies between.
_LAGS = (0.0, 0.06, 0.118)
# A lag is ruled out when its squared error exceeds the best one's by this [rad^2 s]: 45 mrad for a second.
_RULED_OUT = 2e-3
_MOST_SQUARED = 0.04  # rad^2: what one joint may say against a lag in one frame; more is a fault, not a lag
# Difference allowed [rad], and the time [s] by which lag and dead time of the six motors differ from the model.
_ANGLE, _MISTIMED = 0.04, 0.04
_RECENT = 0.15  # s: how long a fast command still widens what is allowed
_FULL = 0.6  # of the torque range: from there on a motor may give less than the law asks for


class MotionWitness:
    """Judges the frames of one motor by themselves; `objection` says what is lastingly wrong with them."""

    def __init__(self, name: str, lower: float = -math.inf, upper: float = math.inf) -> None:
        """`name` of the joint, and its mechanical range [rad]."""
        self.name, self.lower, self.upper = name, lower, upper
        self.objection: str | None = None
        self._position = self._velocity = math.nan
        self._stamp: float | None = None
        self._arrived = self._double_at = self._unsteady_until = -math.inf
        self._doubted, self._doubted_position, self._doubted_at = 0, math.nan, -math.inf
        self._possible, self._from, self._elapsed = False, math.nan, math.nan
        self._turned = self._promised = self._way = 0.0
        self._apart = 0

    def steady(self, now: float) -> bool:
        """Whether frames have lately come in time, so that none can be late."""
        return now >= self._unsteady_until

    def object(self, reason: str) -> None:
        """Raise an objection; the first one stays."""
        if self.objection is None:
            self.objection = reason

    def believes(self, position: float, velocity: float, now: float) -> bool:
        """Whether the joint can be at `position` [rad] with `velocity` [rad/s] now [s]."""
        double = now - self._arrived < _SHORTEST
        if now - self._arrived > _LONGEST or (double and now - self._double_at < _UNSTEADY_FOR / 10):
            self._unsteady_until = now + _UNSTEADY_FOR
            self._restart()
        self._arrived, self._double_at = now, now if double else self._double_at
        inside = self.lower <= position <= self.upper
        if self._stamp is None:
            believed = inside
        else:
            moved, elapsed = abs(position - self._position), now - self._stamp
            # Both velocities: one of them may be damaged.
            speeds = abs(velocity), abs(self._velocity)
            believed = inside and moved <= _JUMP + min(*speeds, _SPEED) * min(elapsed, 0.1)
        if not believed:
            believed = self._doubt(position, velocity, now, inside)
        if believed:
            self._doubted = 0
            if self._stamp is not None:
                self._compare(position, velocity, now - self._stamp)
            self._position, self._velocity, self._stamp = position, velocity, now
        return believed

    def _doubt(self, position: float, velocity: float, now: float, inside: bool) -> bool:
        """Count a doubtful angle; True when enough frames agree on one that is possible."""
        apart = _JUMP + _SPEED * min(now - self._doubted_at, 0.1)
        if not self._doubted or abs(position - self._doubted_position) > apart:
            # The time that the joint had counts up to the first doubt: doubting must not make room.
            self._doubted = 0
            reach = math.inf
            if self._stamp is not None:
                speed = min(max(abs(velocity), abs(self._velocity)), _SPEED)
                reach = _JUMP + _SPEED * min(now - self._stamp, 1.0)
                reach += 0.0 if self.steady(now) else _LATE * speed
                self._elapsed, self._from = now - self._stamp, self._position
            self._possible = self._stamp is None or abs(position - self._position) <= reach
        self._doubted += 1
        self._doubted_position, self._doubted_at = position, now
        self._restart()
        if inside and self._possible:
            return self._doubted >= _AGREEING
        if self._doubted >= _IMPOSSIBLE and not inside:
            self.object(
                f"{self.name} reads {position:.3f} rad, outside its mechanical range "
                f"[{self.lower:.2f}, {self.upper:.2f}]"
            )
        elif self._doubted >= _IMPOSSIBLE:
            self.object(
                f"{self.name} reads {position:.3f} rad, {abs(position - self._from):.3f} rad from its angle "
                f"{self._elapsed * 1e3:.0f} ms before"
            )
        return False

    def _compare(self, position: float, velocity: float, elapsed: float) -> None:
        """Compare the change of the angle with the velocity, over the last second."""
        turned, promised = position - self._position, 0.5 * (velocity + self._velocity) * elapsed
        damaged = abs(velocity - self._velocity) > _DAMAGED or abs(turned - promised) > _JOLT
        if damaged or elapsed > _LONGEST:
            self._restart()
            return
        fading = math.exp(-elapsed / _MEMORY)
        self._turned = self._turned * fading + turned
        self._promised = self._promised * fading + promised
        self._way = self._way * fading + abs(velocity) * elapsed
        apart = abs(self._turned - self._promised) > _DRIFT + _DRIFT_FRACTION * self._way
        self._apart = self._apart + 1 if apart else 0
        if self._apart >= _LASTING:
            self.object(
                f"{self.name} reads {position:.3f} rad, having turned by {self._turned:.3f} rad while its "
                f"velocity says {self._promised:.3f} rad"
            )

    def _restart(self) -> None:
        self._turned = self._promised = self._way = 0.0
        self._apart = 0


class TorqueWitness:
    """Judges the joints of an arm by the torque that its commands and its angles ask for.

    Which of the possible lags the arm has, its own motion tells.
    """

    def __init__(self, names: Sequence[str], q: ArrayLike, torque_ranges: ArrayLike) -> None:
        """Starts at `q` [rad] (dof,); `torque_ranges` [Nm] (dof,) are what the motors can report."""
        self.names = tuple(names)
        start = np.asarray(q, dtype=float)
        self._full = _FULL * np.asarray(torque_ranges, dtype=float)
        self._lags = np.array(_LAGS)[:, None]
        self._first = np.tile(start, (len(_LAGS), 1))
        self._second = self._first.copy()
        self._squared = np.zeros(len(_LAGS))
        self._possible = np.ones(len(_LAGS), dtype=bool)
        self._command = self._position = self._before = start.copy()
        self._torque = np.zeros_like(start)
        self._kp, self._kd = np.ones_like(start), np.zeros_like(start)
        self._rate = np.zeros_like(start)
        self._beyond: NDArray[np.int_] = np.zeros(len(start), dtype=int)
        self._now: float | None = None

    def command(
        self, position: NDArray, velocity: NDArray, torque: NDArray, kp: ArrayLike, kd: ArrayLike
    ) -> None:
        """Take note of the MIT command in force from now on, each (dof,), with `kp` > 0."""
        self._kp, self._kd = np.asarray(kp, dtype=float), np.asarray(kd, dtype=float)
        self._position, self._command = position, position + self._kd / self._kp * velocity
        self._torque = torque

    def judge(
        self, now: float, q: NDArray, dq: NDArray, torque: NDArray, fresh: NDArray, steady: NDArray
    ) -> dict[int, str]:
        """Compare feedback with the commands so far: what is wrong with which joints.

        Args:
            now: time [s].
            q: angles [rad] (dof,).
            dq: velocities [rad/s] (dof,).
            torque: of the motors [Nm] (dof,).
            fresh: which joints reported since the last call, in good order (dof,).
            steady: whose frames can not be late (dof,).
        """
        elapsed = 0.0 if self._now is None else now - self._now
        self._now = now
        self._advance(elapsed)
        acted_on = q + (torque - self._torque + self._kd * dq) / self._kp
        errors = acted_on - self._second
        squared = np.minimum(errors**2, _MOST_SQUARED)[:, fresh].sum(axis=1)
        self._squared += elapsed * squared
        self._possible &= self._squared - self._squared[self._possible].min() < _RULED_OUT
        errors = np.where(self._possible[:, None], errors, np.inf)
        best = np.argmin(np.abs(errors), axis=0)
        error = errors[best, np.arange(len(q))]
        allowed = _ANGLE + np.where(steady, _MISTIMED, _LATE) * self._rate
        beyond = (np.abs(error) > allowed) & ~((np.abs(torque) > self._full) & (torque * error < 0))
        self._beyond = np.where(fresh, np.where(beyond, self._beyond + 1, 0), self._beyond)
        return {
            int(joint): (
                f"{self.names[joint]} reads {q[joint]:.3f} rad, but gives {torque[joint]:.2f} Nm as if it stood "
                f"at {q[joint] - error[joint]:.3f} rad"
            )
            for joint in np.flatnonzero(self._beyond >= _LASTING)
        }

    def _advance(self, elapsed: float) -> None:
        """Let the command in force act for `elapsed` [s] through the lags."""
        if elapsed <= 0.0:
            return
        blend = np.where(self._lags > 0, -np.expm1(-elapsed / np.maximum(self._lags, 1e-9)), 1.0)
        self._first += blend * (self._command - self._first)
        self._second += blend * (self._first - self._second)
        rate = np.abs(self._position - self._before) / elapsed
        self._before = self._position
        self._rate = np.maximum(rate, self._rate * math.exp(-elapsed / _RECENT))
