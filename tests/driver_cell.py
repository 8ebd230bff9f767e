"""A driver and a simulated arm on one bus, an independent listener beside them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np

from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.clock import RealClock
from robot_adapters.simulation.cell import SimulatedCell

QUICK = AirbotSettings(shutdown=0.02)


class SlowMotion(RealClock):
    """The computer's clock at a tenth of its speed: arm and driver run in threads as always, and a computer that
    has other things to do may hold each of them up for ten times as long before the arm counts as lost.
    """

    def monotonic(self) -> float:
        """The time now [s]."""
        return super().monotonic() / 10

    def sleep(self, seconds: float) -> None:
        """Wait ten times as long in real time."""
        super().sleep(seconds * 10)


@contextlib.contextmanager
def connected_cell() -> Iterator[SimulatedCell]:
    """A connected arm on a simulated clock. At the end neither the listener nor the arm may have complained."""
    with SimulatedCell(listen=True, settings=QUICK) as cell:
        cell.arm.connect()
        yield cell
    assert cell.listener.violations == []
    assert cell.simulation.warnings == 0
    assert not cell.simulation.emergency_stopped


def names(events) -> list[str]:
    return [event.name for event in events]


def track(cell, seconds, amplitude=0.2, rate=20.0):
    """Follow a smooth motion; the results of all commands."""
    home, start, results = cell.arm.read().q, cell.clock.monotonic(), []
    while (t := cell.clock.monotonic() - start) < seconds - 1e-6:
        results.append(cell.arm.command(home + amplitude * np.sin(1.5 * t)))
        cell.clock.sleep(1.0 / rate)
    return results
