"""Energy that the machine says it used: RAPL of its processors, NVML of its GPUs, where it has them.

It is that of the whole package or board, idle power and other processes included, so it means something on a
machine left to itself only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

RAPL = Path("/sys/class/powercap")


class EnergyMeter:
    """Counts joules from its making on."""

    def __init__(self, rapl: Path = RAPL) -> None:
        """
        Args:
            rapl: Linux's folder of power caps.
        """
        # Only whole packages: "intel-rapl:0:1" is a part of "intel-rapl:0". AMD's have the same names.
        packages = sorted(path for path in rapl.glob("intel-rapl:*") if path.name.count(":") == 1)
        self._packages = [(path, found) for path in packages if (found := _microjoules(path)) is not None]
        self._boards = [(board, _millijoules(board)) for board in _boards()]

    def joules(self) -> float | None:
        """Energy so far, J; None where the machine cannot tell."""
        if not self._packages and not self._boards:
            return None
        total = 0.0
        for path, before in self._packages:
            now = _microjoules(path)
            if now is None:
                return None
            # The counter starts again from zero after its range.
            full = int((path / "max_energy_range_uj").read_text())
            total += 1e-6 * ((now - before) if now >= before else now + full - before)
        return total + sum(1e-3 * (_millijoules(board) - before) for board, before in self._boards)


def _microjoules(package: Path) -> int | None:
    """The package's counter; None where it may not be read, as for users who are not root."""
    try:
        return int((package / "energy_uj").read_text())
    except OSError:
        return None


def _boards() -> list[Any]:
    """Handles of the GPUs that count energy."""
    try:
        import pynvml

        pynvml.nvmlInit()
        handles = [pynvml.nvmlDeviceGetHandleByIndex(i) for i in range(pynvml.nvmlDeviceGetCount())]
        for handle in handles:
            pynvml.nvmlDeviceGetTotalEnergyConsumption(handle)
    except Exception:
        # No library, no driver, or boards too old to count: all of them mean that there is nothing to read.
        return []
    return handles


def _millijoules(board: Any) -> float:
    import pynvml

    return float(pynvml.nvmlDeviceGetTotalEnergyConsumption(board))
