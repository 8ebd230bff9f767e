"""The soak: hours or minutes of tracking, watched for anything that grows."""

from __future__ import annotations

import gc
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_adapters.arm import DriverStatistics
from robot_adapters.clock import Clock
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.plant import PlantParameters

_PERIOD = 0.05  # s between targets
_STATM = Path("/proc/self/statm")
_PAGE = 4096


@dataclass(frozen=True)
class SoakSample:
    """The process at one time of the soak [s, the cell's clock]: resident memory [bytes], threads, unread
    frames, objects.
    """

    time: float
    memory: int
    threads: int
    unread: int
    objects: int


@dataclass(frozen=True)
class SoakReport:
    """The samples taken along the way, the driver's statistics at the end and what the listener saw."""

    samples: tuple[SoakSample, ...]
    statistics: DriverStatistics
    violations: int
    warnings: int

    @property
    def memory_growth(self) -> int:
        """Memory at the end less that at a third of the time [bytes]; the beginning fills buffers of fixed
        size.
        """
        return self.samples[-1].memory - self.samples[len(self.samples) // 3].memory

    @property
    def object_growth(self) -> int:
        """Python objects at the end less those at a third of the time."""
        return self.samples[-1].objects - self.samples[len(self.samples) // 3].objects


def run_soak(
    seconds: float = 600.0,
    samples: int = 30,
    seed: int = 0,
    clock: Clock | None = None,
    parameters: PlantParameters | None = None,
) -> SoakReport:
    """Track smooth motion at 20 Hz for `seconds` of the cell's time, sampling the process `samples` times.

    `parameters` are those of the simulated arm, such as what it carries.
    """
    random = np.random.default_rng(seed)
    amplitude, phase = random.uniform(0.05, 0.4, 6), random.uniform(0.0, 2 * np.pi, 6)
    taken: list[SoakSample] = []
    with SimulatedCell(clock, seed=seed, listen=True, parameters=parameters) as cell:
        assert cell.listener is not None
        cell.arm.connect()
        start, home = cell.clock.monotonic(), cell.arm.read().q
        while (t := cell.clock.monotonic() - start) < seconds:
            if t >= len(taken) * seconds / samples:
                taken.append(_sample(t, cell.arm.statistics().unread))
            wave = amplitude * (np.sin(1.1 * t + phase) - np.sin(phase))
            cell.arm.command(home + wave, gripper=0.03 + 0.03 * np.sin(0.5 * t))
            cell.clock.sleep(_PERIOD)
            if not cell.clock.simulated:
                cell.listener.poll()
        taken.append(_sample(cell.clock.monotonic() - start, cell.arm.statistics().unread))
        statistics = cell.arm.statistics()
        warnings = cell.simulation.warnings
    return SoakReport(tuple(taken), statistics, len(cell.listener.violations), warnings)


def _sample(time: float, unread: int) -> SoakSample:
    gc.collect()
    memory = int(_STATM.read_text().split()[1]) * _PAGE if _STATM.exists() else 0
    return SoakSample(time, memory, threading.active_count(), unread, len(gc.get_objects()))
