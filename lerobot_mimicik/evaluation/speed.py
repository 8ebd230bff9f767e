"""How fast commands are found, one at a time as a control loop asks: rows that take turns on one machine."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.evaluation.energy import EnergyMeter

WARM_UP = 30  # queries of each row that are not timed: caches fill, the tracer optimises
_TURN = 50  # queries of one row before the next one's turn, so that a busy moment meets all of them
_QUIET = 0.97
"""Fraction of the time that this process runs on a machine that is left to it."""

Ask = Callable[[int], object]
"""Answers the query of a frame of the motion."""


@dataclass(frozen=True)
class Row:
    """What one way to find commands costs.

    Attributes:
        name: What was asked.
        milliseconds: Duration of every query.
        processor_ms: Time that the asking thread ran for each, which a busy machine changes less.
        energy_mj: The machine's energy for a query [mJ]; None where it does not count.
    """

    name: str
    milliseconds: np.ndarray
    processor_ms: np.ndarray
    energy_mj: float | None


@dataclass(frozen=True)
class Machine:
    """How the machine was while it measured.

    Attributes:
        load: Processes that wanted to run before it began, on average over a minute.
        ran: Fraction of the measured time in which this process ran.
        grown_mb: Memory that the process took while it measured [MB].
    """

    load: float
    ran: float
    grown_mb: float

    @property
    def busy(self) -> str:
        """A warning, or nothing."""
        if self.ran >= _QUIET and self.load < 0.5 * (os.cpu_count() or 1):
            return ""
        return (
            f"The machine was busy (load {self.load:.1f} before, this process ran {100 * self.ran:.0f} % of the time): "
            "these numbers say little, measure again on an idle one."
        )


def measure(asked: Mapping[str, Ask], frames: int, queries: int) -> tuple[list[Row], Machine]:
    """Time every row on the same motion, in turns.

    Args:
        asked: What is measured, by name.
        frames: Length of the motion, which begins again where it ends.
        queries: How many of each row are timed.

    Raises:
        ValueError: `queries` is below one.
    """
    if queries < 1:
        raise ValueError(f"queries={queries}: expected at least one")
    load, energy = os.getloadavg()[0], dict.fromkeys(asked, 0.0)
    spent, own = ({name: np.empty(queries) for name in asked} for _ in range(2))
    for ask in asked.values():
        for i in range(WARM_UP):
            ask(i % frames)
    counted, before = True, _memory_mb()
    wall, ran = time.perf_counter(), time.process_time()
    for first in range(0, queries, _TURN):
        for name, ask in asked.items():
            meter = EnergyMeter()
            for i in range(first, min(first + _TURN, queries)):
                began, begin = time.thread_time(), time.perf_counter()
                ask((WARM_UP + i) % frames)
                spent[name][i] = time.perf_counter() - begin
                own[name][i] = time.thread_time() - began
            joules = meter.joules()
            counted = counted and joules is not None
            energy[name] += joules or 0.0
    machine = Machine(
        load,
        (time.process_time() - ran) / (time.perf_counter() - wall),
        _memory_mb() - before,
    )
    rows = [
        Row(name, 1e3 * spent[name], 1e3 * own[name], 1e3 * energy[name] / queries if counted else None)
        for name in asked
    ]
    return rows, machine


def table(rows: Sequence[Row], reference: str = "") -> str:
    """The rows as Markdown; `reference` names the one that ratios are against, empty: none are given."""
    base = next((float(np.median(row.milliseconds)) for row in rows if row.name == reference), None)
    against = "" if base is None else f" times faster than {reference} |"
    lines = [
        f"| row | p50 ms | p95 ms | p99 ms | p99 / p50 | processor p50 ms |{against} energy mJ |",
        "|---|" + "---:|" * (6 if base is None else 7),
    ]
    for row in rows:
        p50, p95, p99 = np.percentile(row.milliseconds, (50, 95, 99))
        energy = "not counted" if row.energy_mj is None else f"{row.energy_mj:.2f}"
        ratio = "" if base is None else f" {base / p50:.1f} |"
        lines.append(
            f"| {row.name} | {p50:.3f} | {p95:.3f} | {p99:.3f} | {p99 / p50:.2f} | {np.median(row.processor_ms):.3f} |"
            f"{ratio} {energy} |"
        )
    return "\n".join(lines)


def _memory_mb() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
