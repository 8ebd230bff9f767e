"""How well the machine kept up while a test ran in real time: what such a test is judged against."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

_HELD_UP = 0.05  # s: half of what the driver waits for feedback
_OTHERS = 0.25  # of the processors' time: on two cores, driver and simulated arm then have less than theirs


class Pace:
    """A thread that sleeps 2 ms over and over, and how late it came at worst; how busy others kept the processors."""

    def __init__(self) -> None:
        self.worst = self.others = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="pace", daemon=True)

    @property
    def kept(self) -> bool:
        """Whether the machine had time for something that must run every few milliseconds."""
        return self.worst < _HELD_UP and self.others < _OTHERS

    def __str__(self) -> str:
        return (
            f"the machine held this process up for {self.worst * 1e3:.0f} ms at worst, and others used "
            f"{self.others:.0%} of its processors"
        )

    def __enter__(self) -> Pace:
        self._begin = _processor_times()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        total, busy, own = (end - begin for begin, end in zip(self._begin, _processor_times(), strict=True))
        self.others = max(busy - own, 0.0) / total if total else 0.0

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._ended.wait(0.002):
            now = time.monotonic()
            self.worst, before = max(self.worst, now - before - 0.002), now


@contextlib.contextmanager
def judged_by_the_pace() -> Iterator[None]:
    """A block that runs an arm in real time: where it fails on a machine that did not keep up, the test is skipped
    and says so; elsewhere the failure says what the machine did.
    """
    pace = Pace()
    try:
        with pace:
            yield
    except Exception as error:
        if not pace.kept:
            pytest.skip(f"not judged: {pace} ({type(error).__name__}: {str(error)[:300]})")
        error.add_note(f"It was not the machine: {pace}.")
        raise


def _processor_times() -> tuple[float, float, float]:
    """Seconds of all processors so far: all, all but idle, and this process's; zeros where it is not told."""
    stat = Path("/proc/stat")
    if not stat.is_file():
        return 0.0, 0.0, 0.0
    # user nice system idle iowait irq softirq steal
    ticks = [int(word) / os.sysconf("SC_CLK_TCK") for word in stat.read_text().splitlines()[0].split()[1:9]]
    return sum(ticks), sum(ticks) - ticks[3] - ticks[4], time.process_time()
