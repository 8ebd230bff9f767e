"""A trembling hand: band-limited noise on poses, translation with the rotation that goes with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

BAND_HZ = (3.0, 9.0)  # of the hand's physiological tremor as far as 20 Hz can show it
_DEGREES_PER_MM = 0.5


def tremor(
    frames: int, fps: float, rms_mm: float, rng: np.random.Generator, band_hz: tuple[float, float] = BAND_HZ
) -> Array:
    """Noise (frames, 6), m and rad, within a band.

    The root mean square of the translation's length is `rms_mm`, of the rotation's angle half a degree per mm.

    Raises:
        ValueError: If the frames are too few or too slow to show the band.
    """
    frequency = np.fft.rfftfreq(frames, 1 / fps)
    inside = (frequency >= band_hz[0]) & (frequency <= min(band_hz[1], 0.49 * fps))
    if not inside.any():
        raise ValueError(f"{frames} frames at {fps:g} fps cannot show a tremor of {band_hz[0]:g} Hz or more")
    real, imaginary = rng.normal(size=(2, len(frequency), 6))
    wave = np.fft.irfft(inside[:, None] * (real + 1j * imaginary), n=frames, axis=0)
    wave /= np.sqrt((wave**2).mean(axis=0))
    # Three axes of equal size make up the length.
    return wave * np.repeat([1e-3 * rms_mm, np.radians(_DEGREES_PER_MM * rms_mm)], 3) / np.sqrt(3)


def displaced(poses: Array, twist: Array) -> Array:
    """Poses (T, 7) moved by `twist` (T, 6), m and rotation vector in rad, in the base frame."""
    turned = Rotation.from_rotvec(twist[:, 3:]) * Rotation.from_quat(poses[:, 3:])
    return np.column_stack([poses[:, :3] + twist[:, :3], turned.as_quat(canonical=True)])
