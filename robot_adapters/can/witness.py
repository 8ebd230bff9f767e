"""What contradicts a motor's feedback: its range, its own velocity, its torque and the commands it was given.

`MotionWitness` judges the frames of one motor by themselves: an angle must lie in the joint's mechanical
range, be within reach of the angle before it, and change as the reported velocity says. `TorqueWitness` judges
the joints of an arm against its commands: a motor under the MIT law gives the torque

    torque = kp (p - q) + kd (v - dq) + feed-forward

so angle, velocity and torque together tell the command (p, v) that the motor acts on, whatever the joint
carries, meets or rubs against. That command must be the one sent, up to the motor's lag: see docs/safety.md for
how well the two agree on logs of a real arm.
"""

from __future__ import annotations

import math
from collections import deque
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
# next half second may be late: by as many of the longest gaps between frames as a sender holds frames back (a motor
# has some three mailboxes), and by a quarter of a second at most. A motor that was silent for longer may not have
# heard its commands for as long.
_SHORTEST, _LONGEST = 0.0005, 0.010
_UNSTEADY_FOR, _HELD_BACK, _LATE = 0.5, 3, 0.25
_MEMORY_OF_COMMANDS = 1.0  # s: a motor that is silent for longer is lost
# Angle against integrated velocity: memory [s], difference allowed [rad] and fraction of the way travelled. Real
# logs differ by a tenth of (0.05 rad + the way).
_MEMORY, _DRIFT, _DRIFT_FRACTION = 1.0, 0.04, 0.15
# From one frame to the next, a velocity that changes by more [rad/s] or an angle that differs from it by more
# [rad] belongs to a damaged frame, and says nothing of what lasts.
_DAMAGED, _JOLT = 3.0, 0.02
# Shares of the joints' lags that the arm may have: none (bare MIT motors), all (the vendor's joint-following mode),
# and what lies between.
_SHARES = (0.0, 0.5, 1.0)
# A lag is ruled out when its squared error exceeds the best one's by this [rad^2 s]: 45 mrad for a second.
_RULED_OUT = 2e-3
_MOST_SQUARED = 0.04  # rad^2: what one joint may say against a lag in one frame; more is a fault, not a lag
# Difference allowed [rad], and the time [s] by which lag and dead time of the six motors may differ from the model:
# on real logs no more than 0.013 rad is needed beside these 20 ms. Of the lateness of a frame, that share by which
# its feed-forward may differ from the one in force.
_ANGLE, _MISTIMED, _OUTDATED = 0.03, 0.02, 0.1
_RECENT = 0.25  # s: how long a fast command still widens what is allowed
_FULL = 0.6  # of the torque range: from there on a motor may give less than the law asks for


class MotionWitness:
    """Judges the frames of one motor by themselves; `objection` says what is lastingly wrong with them."""

    def __init__(
        self,
        name: str,
        lower: float = -math.inf,
        upper: float = math.inf,
        position: float = math.nan,
        now: float | None = None,
    ) -> None:
        """`name` of the joint, its mechanical range [rad], and the angle [rad] at which it rests `now` [s], if known."""
        self.name, self.lower, self.upper = name, lower, upper
        self.objection: str | None = None
        self._position, self._velocity = position, 0.0
        self._stamp = now
        self._arrived: float | None = None
        self._gap, self._gap_at = 0.0, -math.inf  # the longest gap lately, and when it ended [s]
        self._double_at = self._unsteady_until = -math.inf
        self._doubted, self._doubted_position, self._doubted_at = 0, math.nan, -math.inf
        self._possible, self._from, self._elapsed = False, math.nan, math.nan
        self._turned = self._promised = self._way = 0.0
        self._apart = 0

    def lateness(self, now: float) -> float:
        """By how much a frame may be late [s]; 0 where frames have lately come in time."""
        if now >= self._unsteady_until:
            return 0.0
        return max(min(_HELD_BACK * max(self._gap, _LONGEST), _LATE), self._gap)

    def object(self, reason: str) -> None:
        """Raise an objection; the first one stays."""
        if self.objection is None:
            self.objection = reason

    def believes(self, position: float, velocity: float, now: float) -> bool:
        """Whether the joint can be at `position` [rad] with `velocity` [rad/s] now [s]."""
        self._arrive(now)
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

    def _arrive(self, now: float) -> None:
        """Note whether frames come in time."""
        if self._arrived is not None:
            gap = now - self._arrived
            if gap >= self._gap or now - self._gap_at > _UNSTEADY_FOR:
                self._gap, self._gap_at = gap, now
            double = gap < _SHORTEST
            if gap > _LONGEST or (double and now - self._double_at < _UNSTEADY_FOR / 10):
                self._unsteady_until = now + _UNSTEADY_FOR
                self._restart()
            self._double_at = now if double else self._double_at
        self._arrived = now

    def _doubt(self, position: float, velocity: float, now: float, inside: bool) -> bool:
        """Count a doubtful angle; True when enough frames agree on one that is possible."""
        apart = _JUMP + _SPEED * min(now - self._doubted_at, 0.1)
        if not self._doubted or abs(position - self._doubted_position) > apart:
            # The time that the joint had counts up to the first doubt: doubting must not make room.
            self._doubted = 0
            self._possible = self._stamp is None
            if self._stamp is not None:
                self._elapsed, self._from = now - self._stamp, self._position
                reach = _JUMP + _SPEED * min(self._elapsed, 1.0)
                # Frames do not overtake each other: what was late only leads on in the direction of motion.
                late, speeds = self.lateness(now), (0.0, velocity, self._velocity)
                least, most = max(min(speeds), -_SPEED) * late, min(max(speeds), _SPEED) * late
                self._possible = least - reach <= position - self._position <= most + reach
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

    Which share of its lags the arm has, its own motion tells.
    """

    def __init__(self, names: Sequence[str], q: ArrayLike, torque_ranges: ArrayLike, lags: ArrayLike) -> None:
        """Starts at `q` [rad] (dof,).

        `torque_ranges` [Nm] (dof,) are what the motors can report; `lags` [s] (dof,) the time constants of each of
        the two first-order lags with which they follow commands, where they do not follow at once.
        """
        self.names = tuple(names)
        start = np.asarray(q, dtype=float)
        self._full = _FULL * np.asarray(torque_ranges, dtype=float)
        self._lags = np.outer(_SHARES, np.asarray(lags, dtype=float))
        self._first = np.tile(start, (len(_SHARES), 1))
        self._second = self._first.copy()
        self._past: deque[tuple[float, NDArray[np.float64]]] = deque()  # times, `_second`
        self._squared = np.zeros(len(_SHARES))
        self._possible = np.ones(len(_SHARES), dtype=bool)
        self._command = self._position = self._before = start.copy()
        self._torque = np.zeros_like(start)
        self._kp, self._kd = np.ones_like(start), np.zeros_like(start)
        self._rate = np.zeros_like(start)
        self._beyond: NDArray[np.int_] = np.zeros(len(start), dtype=int)
        self._now: float | None = None

    @property
    def expected(self) -> NDArray[np.float64]:
        """Where the commands have led the joints by now, were they not hindered [rad] (dof,)."""
        return self._second[int(np.argmin(self._squared))].copy()

    def command(
        self, position: NDArray, velocity: NDArray, torque: NDArray, kp: ArrayLike, kd: ArrayLike
    ) -> None:
        """Take note of the MIT command in force from now on, each (dof,), with `kp` > 0."""
        self._kp, self._kd = np.asarray(kp, dtype=float), np.asarray(kd, dtype=float)
        self._position, self._command = position, position + self._kd / self._kp * velocity
        self._torque = torque

    def judge(
        self, now: float, q: NDArray, dq: NDArray, torque: NDArray, fresh: NDArray, late: NDArray
    ) -> dict[int, str]:
        """Compare feedback with the commands so far: what is wrong with which joints.

        Args:
            now: Time [s].
            q: Angles [rad] (dof,).
            dq: Velocities [rad/s] (dof,).
            torque: Of the motors [Nm] (dof,).
            fresh: Which joints reported since the last call, in good order (dof,).
            late: By how much each joint's frame may be late [s] (dof,).
        """
        elapsed = 0.0 if self._now is None else now - self._now
        self._now = now
        self._advance(elapsed)
        acted_on = q + (torque - self._torque + self._kd * dq) / self._kp
        errors = acted_on - self._nearest(acted_on, late, now)
        squared = np.minimum(errors**2, _MOST_SQUARED)[:, fresh].sum(axis=1)
        self._squared += elapsed * squared
        self._possible &= self._squared - self._squared[self._possible].min() < _RULED_OUT
        errors = np.where(self._possible[:, None], errors, np.inf)
        best = np.argmin(np.abs(errors), axis=0)
        error = errors[best, np.arange(len(q))]
        allowed = _ANGLE + (_MISTIMED + _OUTDATED * late) * self._rate
        beyond = (np.abs(error) > allowed) & ~((np.abs(torque) > self._full) & (torque * error < 0))
        self._beyond = np.where(fresh, np.where(beyond, self._beyond + 1, 0), self._beyond)
        return {
            int(joint): (
                f"{self.names[joint]} reads {q[joint]:.3f} rad, but gives {torque[joint]:.2f} Nm as if it stood "
                f"at {q[joint] - error[joint]:.3f} rad"
            )
            for joint in np.flatnonzero(self._beyond >= _LASTING)
        }

    def _nearest(self, acted_on: NDArray, late: NDArray, now: float) -> NDArray[np.float64]:
        """Of the angles that each lag made of the commands as long ago as frames may be late, the nearest."""
        self._past.append((now, self._second.copy()))
        while self._past[0][0] < now - _MEMORY_OF_COMMANDS:
            self._past.popleft()
        longest = late.max()
        if longest <= 0.0:
            return self._second
        recent = [(time, second) for time, second in self._past if time >= now - longest]
        seconds = np.stack([second for _, second in recent])
        within = (np.array([time for time, _ in recent])[:, None] >= now - late)[:, None, :]
        lowest = np.where(within, seconds, np.inf).min(axis=0)
        highest = np.where(within, seconds, -np.inf).max(axis=0)
        return np.clip(acted_on, lowest, highest)

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
