"""Chunks of a policy that contradict each other: the target jumps at every seam."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion

CHUNK = (8, 16)  # poses, as policies answer
JUMP_M = 0.02  # largest jump at a seam


def spliced_chunks(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    """Everyday motion in chunks, each displaced by its own constant offset."""
    q = everyday_motion(arm, frames + 1, fps, rng)
    twist = np.zeros((frames, 6))
    begin = 0
    while begin < frames:
        length = int(rng.integers(CHUNK[0], CHUNK[1] + 1))
        direction = rng.normal(size=3)
        # Evenly in a ball of half the jump: two offsets are at most one jump apart.
        offset = 0.5 * JUMP_M * rng.uniform() ** (1 / 3) * direction / np.linalg.norm(direction)
        twist[begin : begin + length, :3] = offset
        begin += length
    return [StressCase.along(arm, q, "Chunks that do not fit together", twist)]
