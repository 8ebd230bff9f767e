"""Clocks: the real one, and simulated ones that run what is scheduled on them whenever somebody sleeps.

Everything below that waits or runs periodically takes a `Clock`. On a `SimulatedClock` the arm, its driver
and the caller share one thread: `clock.sleep(0.05)` runs every callback due in the next 50 ms in order of
time, as fast as the computer can, and always in the same order.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """What a driver needs of time, in seconds from an arbitrary start."""

    simulated: bool

    def monotonic(self) -> float:
        """The time now [s]."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; negative waits are none."""
        ...


class RealClock:
    """The computer's monotonic clock."""

    simulated = False

    def monotonic(self) -> float:
        """The time now [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait in real time."""
        if seconds > 0:
            time.sleep(seconds)


class Schedule:
    """One periodic callback on a `SimulatedClock`."""

    def __init__(self, start: float, period: float, callback: Callable[[], None]) -> None:
        self.start, self.period, self.callback = start, period, callback
        self.count = 0
        self.cancelled = self.paused = False

    def cancel(self) -> None:
        """Run the callback no more; cancelling twice is harmless."""
        self.cancelled = True

    @property
    def due(self) -> float:
        """When the callback runs next [s], without accumulated rounding."""
        return self.start + self.count * self.period


class SimulatedClock:
    """Time that passes only in `sleep`, which runs the scheduled callbacks on the way."""

    simulated = True

    def __init__(self) -> None:
        self._now = 0.0
        self._queue: list[tuple[float, int, Schedule]] = []
        self._order = itertools.count()
        self._running = False

    def monotonic(self) -> float:
        """The time now [s]; 0 at the start."""
        return self._now

    def every(self, period: float, callback: Callable[[], None], delay: float = 0.0) -> Schedule:
        """Run `callback` at now + `delay` and every `period` [s] from there, until the result is cancelled.

        Callbacks due at the same time run in the order in which they were scheduled. ValueError unless
        `period` > 0.
        """
        if not period > 0:
            raise ValueError(f"a period must be positive, got {period}")
        schedule = Schedule(self._now + delay, period, callback)
        heapq.heappush(self._queue, (schedule.due, next(self._order), schedule))
        return schedule

    def sleep(self, seconds: float) -> None:
        """Let `seconds` pass and run what is due. RuntimeError when called by a callback: it would wait for
        itself.
        """
        if self._running:
            raise RuntimeError("a callback of the simulated clock must not sleep")
        end = self._now + max(seconds, 0.0)
        self._running = True
        try:
            while self._queue and self._queue[0][0] <= end + 1e-9:
                due, order, schedule = heapq.heappop(self._queue)
                self._now = max(self._now, due)
                if schedule.cancelled:
                    continue
                schedule.count += 1
                heapq.heappush(self._queue, (schedule.due, order, schedule))
                if not schedule.paused:
                    schedule.callback()
        finally:
            self._running = False
        self._now = max(self._now, end)


class PatientClock(SimulatedClock):
    """Simulated time that follows the computer's, and waits for a computer that is too slow.

    For programs that wait in real time by themselves, such as LeRobot's commands: they call `catch_up` at every
    observation and action. A program that is held up in between finds that hardly any time has passed.
    """

    def __init__(self, most: float = 0.1) -> None:
        """At most `most` [s] pass at once; the default is below every timeout of the driver's targets."""
        super().__init__()
        self._most = most
        self._seen = time.monotonic()
        self._one_at_a_time = threading.Lock()

    def catch_up(self) -> None:
        """Let the time pass that the computer's clock has gone on since the last call, `most` at the most.

        May be called from any thread; while one of them catches up, the others do nothing.
        """
        if self._one_at_a_time.acquire(blocking=False):
            try:
                now = time.monotonic()
                self.sleep(min(now - self._seen, self._most))
                self._seen = now
            finally:
                self._one_at_a_time.release()
