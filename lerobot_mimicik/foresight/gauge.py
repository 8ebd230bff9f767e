"""How much a stream of targets trembles."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.foresight.features import legendre

Array = NDArray[np.float64]

_MOST_ROUGH = 4
"""Highest orders of the last targets that a tremor is measured by: with fourteen targets, what no polynomial of degree nine
explains. In real hands without a tremor that is 0.06 mm (median), of a tremor of 1 mm it is 1.1 mm."""
_FEWEST = 5
"""Targets from which the first measurement is made, by their fourth order alone: 0.05 mm without a tremor, 0.9 mm with."""
_MEMORY = 25  # measurements, 1.2 s at 20 Hz
_QUIETEST = 0.1
"""Of the last measurements the estimate is exceeded by all but this fraction: a hand that starts or stops is rough for
some frames, a trembling one is rough in all of them."""


class TremorGauge:
    """Measures what no smooth motion explains of the last targets.

    Attributes:
        tremor: Root mean square of the trembling, translation [m] and rotation [rad]; zeros while too little is known.
    """

    def __init__(self, history: int) -> None:
        """`history` targets are looked at."""
        self._history = history
        # Of fewer targets fewer orders are rough: a quarter of a second of motion takes three of them.
        self._bases = {
            n: legendre(n)[n - min(_MOST_ROUGH, (n - 3) // 2) :] for n in range(_FEWEST, history + 1)
        }
        self.reset()

    def reset(self) -> None:
        """Forget all targets."""
        self._targets: deque[Array] = deque(maxlen=self._history)
        self._measured: tuple[deque[float], ...] = (deque(maxlen=_MEMORY), deque(maxlen=_MEMORY))
        self.tremor = (0.0, 0.0)

    def update(self, target: Array) -> None:
        """Take the next target (7,) into account."""
        # Four numbers of a unit quaternion differ by half of the angle between two rotations that are close.
        last = self._targets[-1] if self._targets else np.array([0.0, 0.0, 0.0, *(2.0 * target[3:])])
        sign = -2.0 if float(target[3:] @ last[3:]) < 0 else 2.0
        self._targets.append(np.concatenate([target[:3], sign * target[3:]]))
        basis = self._bases.get(len(self._targets))
        if basis is None:
            return
        rough = basis @ np.array(self._targets)
        for measured, part in zip(self._measured, (rough[:, :3], rough[:, 3:]), strict=True):
            measured.append(float(np.sqrt((part**2).sum() / len(part))))
        low = int(_QUIETEST * len(self._measured[0]))
        self.tremor = (sorted(self._measured[0])[low], sorted(self._measured[1])[low])
