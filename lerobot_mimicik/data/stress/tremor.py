"""A trembling hand: everyday motion, or recorded motion that somebody steadier made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion
from lerobot_mimicik.kinematics.tremor import displaced, tremor


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """A recording of T frames: measured joints (T, dof) [rad, m] and `T_base_tool` that was asked for, (T, 7), xyzw."""

    state: Array
    target: Array


def trembling(
    arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator, rms_mm: float
) -> list[StressCase]:
    """Everyday motion of a hand that trembles; the same motion and the same tremor, scaled, for every `rms_mm`."""
    q = everyday_motion(arm, frames + 1, fps, rng)
    shaking = tremor(frames, fps, 1.0, rng) * rms_mm
    return [StressCase.along(arm, q, f"Everyday motion, tremor of {rms_mm:g} mm", shaking)]


def recorded_trembling(
    motion: RecordedMotion, frames: int, fps: float, rng: np.random.Generator, rms_mm: float
) -> StressCase:
    """The first `frames` of a recorded motion with tremor added to its targets, scaled from the same for every `rms_mm`."""
    state, clean = motion.state[:frames], motion.target[:frames]
    shaking = tremor(len(state), fps, 1.0, rng) * rms_mm
    return StressCase(
        state=state,
        action=np.concatenate([state[1:], state[-1:]]),
        asked=displaced(clean, shaking),
        clean=clean,
        task=f"Recorded motion, tremor of {rms_mm:g} mm",
    )
