"""Random numbers that belong to a sample, not to a process.

Drawn from a hash of (seed, training step, frame index, dimension), they are the same however many
processes share a batch and wherever a run was interrupted. That is what lets a two-process run equal the
single-process run, and a resumed run the uninterrupted one.
"""

import math

import torch
from torch import Tensor

# splitmix64 (Steele, Lea & Flood 2014), written as signed 64-bit integers, which is what torch multiplies.
_GAMMA = 0x9E3779B97F4A7C15 - (1 << 64)
_MIX_1 = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_2 = 0x94D049BB133111EB - (1 << 64)


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical right shift (torch's is arithmetic)."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    x = x + _GAMMA
    x = (x ^ _shift_right(x, 30)) * _MIX_1
    x = (x ^ _shift_right(x, 27)) * _MIX_2
    return x ^ _shift_right(x, 31)


def sample_uniform(index: Tensor, dim: int, *, seed: int, step: Tensor | int) -> Tensor:
    """Uniform numbers in (0, 1) for each sample.

    Args:
        index: Global frame index of each sample, int64, shape (B,).
        dim: How many numbers a sample gets.
        seed: Seed of the run.
        step: Training step.

    Returns:
        float32, shape (B, dim), on the device of `index`.
    """
    step = torch.as_tensor(step, dtype=torch.int64, device=index.device)
    key = _mix(_mix(_mix(torch.full_like(index, seed)) ^ step) ^ index)
    bits = _shift_right(_mix(key[:, None] ^ torch.arange(dim, device=index.device)), 40)
    return (bits.to(torch.float32) + 0.5) * 2.0**-24


def sample_normal(index: Tensor, dim: int, *, seed: int, step: Tensor | int) -> Tensor:
    """Standard normal numbers for each sample (Box-Muller); arguments as for `sample_uniform`."""
    half = (dim + 1) // 2
    radius, angle = sample_uniform(index, 2 * half, seed=seed, step=step).chunk(2, dim=-1)
    radius = (-2.0 * radius.log()).sqrt()
    angle = 2.0 * math.pi * angle
    return torch.cat([radius * angle.cos(), radius * angle.sin()], dim=-1)[:, :dim]
