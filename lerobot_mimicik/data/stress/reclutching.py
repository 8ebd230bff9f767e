"""Re-clutching: the operator lets go, moves the hand, and takes hold again somewhere else."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion

_ON_S, _OFF_S = (1.5, 4.0), (0.4, 1.0)


def reclutching(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    """Everyday motion with gaps: the target rests while the hand is off, and then jumps to where the hand is."""
    hand = everyday_motion(arm, frames + 1, fps, rng)
    shown = np.arange(frames + 1)
    begin = 0
    while True:
        off = begin + round(rng.uniform(*_ON_S) * fps)
        on = off + round(rng.uniform(*_OFF_S) * fps)
        if on > frames:
            break
        shown[off:on] = off
        begin = on
    return [StressCase.along(arm, hand[shown], "Re-clutching")]
