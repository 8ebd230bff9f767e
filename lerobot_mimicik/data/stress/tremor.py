"""A trembling hand: band-limited noise on the target, translation with the rotation that goes with it."""

from __future__ import annotations

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import everyday_motion

BAND_HZ = (3.0, 9.0)  # of the hand's physiological tremor as far as 20 Hz can show it
_DEGREES_PER_MM = 0.5


def tremor(frames: int, fps: float, rms_mm: float, rng: np.random.Generator) -> Array:
    """Noise (frames, 6), m and rad, within `BAND_HZ`.

    The root mean square of the translation's length is `rms_mm`, of the rotation's angle half a degree per mm.

    Raises:
        ValueError: If the frame rate is too low to show the band.
    """
    frequency = np.fft.rfftfreq(frames, 1 / fps)
    inside = (frequency >= BAND_HZ[0]) & (frequency <= min(BAND_HZ[1], 0.49 * fps))
    if not inside.any():
        raise ValueError(f"{frames} frames at {fps:g} fps cannot show a tremor of {BAND_HZ[0]:g} Hz or more")
    real, imaginary = rng.normal(size=(2, len(frequency), 6))
    wave = np.fft.irfft(inside[:, None] * (real + 1j * imaginary), n=frames, axis=0)
    wave /= np.sqrt((wave**2).mean(axis=0))
    # Three axes of equal size make up the length.
    return wave * np.repeat([1e-3 * rms_mm, np.radians(_DEGREES_PER_MM * rms_mm)], 3) / np.sqrt(3)


def trembling(
    arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator, rms_mm: float
) -> list[StressCase]:
    """Everyday motion of a hand that trembles; the same motion and the same tremor, scaled, for every `rms_mm`."""
    q = everyday_motion(arm, frames + 1, fps, rng)
    shaking = tremor(frames, fps, 1.0, rng) * rms_mm
    return [StressCase.along(arm, q, f"Everyday motion, tremor of {rms_mm:g} mm", shaking)]
