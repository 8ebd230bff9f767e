"""The numbers that a generative objective draws for a query, in numpy; as `lerobot_mimicik.noise` draws them in torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_GAMMA, _MIX_1, _MIX_2 = (np.uint64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """splitmix64 (Steele, Lea & Flood 2014)."""
    x = x + _GAMMA
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return x ^ (x >> np.uint64(31))


def query_normal(dim: int, *, seed: int, query: int) -> NDArray[np.float32]:
    """Standard normal numbers (1, dim) of a query, counted from 0: those of a batch's first row."""
    half = (dim + 1) // 2
    key = _mix(_mix(_mix(np.full(1, seed, np.int64).astype(np.uint64)) ^ np.uint64(query)))
    bits = _mix(key ^ np.arange(2 * half, dtype=np.uint64)) >> np.uint64(40)
    radius, angle = np.split((bits.astype(np.float32) + np.float32(0.5)) * np.float32(2.0**-24), 2)
    radius, angle = np.sqrt(-2.0 * np.log(radius)), np.float32(2.0 * np.pi) * angle
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[None, :dim].astype(np.float32)
