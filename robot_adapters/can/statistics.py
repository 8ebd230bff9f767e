"""Counts and timings of the driver: frames, ticks, targets and events."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from robot_adapters.arm import DriverStatistics

_WINDOW = 15_000  # ticks kept for the percentiles: one minute at 250 Hz


@dataclass
class Recorder:
    """Collects what `DriverStatistics` reports; memory does not grow with time."""

    ticks: int = 0
    overruns: int = 0
    sent: int = 0
    unknown: int = 0
    send_errors: int = 0
    targets: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    _starts: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _busy: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _age_max: float = 0.0

    def tick(self, start: float, end: float, age: float) -> None:
        """Note one tick of the loop: its start and end [s] and the age of the oldest feedback [s]."""
        self.ticks += 1
        self._starts.append(start)
        self._busy.append(end - start)
        if np.isfinite(age):
            self._age_max = max(self._age_max, age)

    def summary(self, received: dict[int, int], implausible: int, unread: int) -> DriverStatistics:
        """The statistics so far."""
        periods = np.diff(np.array(self._starts)) * 1e3
        busy = np.array(self._busy) * 1e3
        some = len(periods) > 0
        return DriverStatistics(
            ticks=self.ticks,
            overruns=self.overruns,
            period_mean_ms=float(periods.mean()) if some else 0.0,
            period_p99_ms=float(np.percentile(periods, 99)) if some else 0.0,
            period_max_ms=float(periods.max()) if some else 0.0,
            jitter_std_ms=float(periods.std()) if some else 0.0,
            busy_p99_ms=float(np.percentile(busy, 99)) if some else 0.0,
            age_max_ms=self._age_max * 1e3,
            frames_sent=self.sent,
            frames_received=received,
            frames_unknown=self.unknown,
            frames_implausible=implausible,
            send_errors=self.send_errors,
            unread=unread,
            targets_accepted=self.targets["accepted"],
            targets_limited=self.targets["limited"],
            targets_refused=self.targets["refused"],
            events=dict(self.events),
        )
