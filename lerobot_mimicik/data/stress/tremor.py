"""Everyday motion of a trembling hand."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion
from lerobot_mimicik.kinematics.tremor import tremor


def trembling(
    arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator, rms_mm: float
) -> list[StressCase]:
    """Everyday motion of a hand that trembles; the same motion and the same tremor, scaled, for every `rms_mm`."""
    q = everyday_motion(arm, frames + 1, fps, rng)
    shaking = tremor(frames, fps, 1.0, rng) * rms_mm
    return [StressCase.along(arm, q, f"Everyday motion, tremor of {rms_mm:g} mm", shaking)]
