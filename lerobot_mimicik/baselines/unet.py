"""A conditional 1-D UNet over the action horizon, for the diffusion baseline.

    x (B, T_a, n_a) ──> block, block ──> halve ──> block, block ──> middle ──> block, block ──> ... ──> noise
                             └───────────── skip ────────────────────────────────┘
    every block is shifted and scaled by the condition: embedded noise level and encoded observations

MimicIK answers one step, so T_a = 1 and every resolution has length one: a convolution then sees its
centre tap alone. The network takes longer horizons as they are.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of a noise level, then a small MLP."""

    frequencies: Tensor

    def __init__(self, dim: int):
        super().__init__()
        exponents = torch.arange(dim // 2) / (dim // 2 - 1)
        self.register_buffer("frequencies", torch.exp(-math.log(10_000.0) * exponents), persistent=False)
        self.layers = nn.Sequential(nn.Linear(dim, 4 * dim), nn.Mish(), nn.Linear(4 * dim, dim))

    def forward(self, step: Tensor) -> Tensor:
        """Noise levels, shape (B,), to embeddings, shape (B, dim)."""
        phase = step[:, None] * self.frequencies
        return self.layers(torch.cat([phase.sin(), phase.cos()], dim=-1))


def _convolution(before: int, after: int, kernel_size: int, n_groups: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv1d(before, after, kernel_size, padding=kernel_size // 2),
        nn.GroupNorm(n_groups, after),
        nn.Mish(),
    )


class ResidualBlock(nn.Module):
    """Two convolutions; the condition shifts and scales what is between them."""

    def __init__(self, before: int, after: int, condition_dim: int, kernel_size: int, n_groups: int):
        super().__init__()
        self.first = _convolution(before, after, kernel_size, n_groups)
        self.modulation = nn.Sequential(nn.Mish(), nn.Linear(condition_dim, 2 * after))
        self.second = _convolution(after, after, kernel_size, n_groups)
        self.shortcut = nn.Conv1d(before, after, 1) if before != after else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Maps (B, before, T) to (B, after, T), given (B, condition_dim)."""
        shift, scale = self.modulation(condition).unsqueeze(-1).chunk(2, dim=1)
        return self.second(self.first(x) * (1 + scale) + shift) + self.shortcut(x)


class ConditionalUNet(nn.Module):
    """Predicts the noise in an action.

    Args:
        obs_dim: Numbers in the observation history T_o * n.
        action_dim: Width of an action n_a.
        channels: Channels of each resolution, from the finest; multiples of `n_groups`.
        kernel_size: Taps of a convolution, odd.
        n_groups: Groups of channels that are normalised together.
        condition_dim: Width of the embedded noise level and of the encoded observations, each; even.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        *,
        channels: Sequence[int] = (128, 256, 512),
        kernel_size: int = 3,
        n_groups: int = 8,
        condition_dim: int = 128,
    ):
        super().__init__()
        self.embed_step = StepEmbedding(condition_dim)
        self.encode = nn.Sequential(
            nn.Linear(obs_dim, 4 * condition_dim), nn.Mish(), nn.Linear(4 * condition_dim, condition_dim)
        )

        def pair(before: int, after: int) -> nn.ModuleList:
            settings = (2 * condition_dim, kernel_size, n_groups)
            return nn.ModuleList(
                [ResidualBlock(before, after, *settings), ResidualBlock(after, after, *settings)]
            )

        widths = [action_dim, *channels]
        self.down = nn.ModuleList(pair(*step) for step in pairwise(widths))
        self.halve = nn.ModuleList(nn.Conv1d(width, width, 3, stride=2, padding=1) for width in channels[:-1])
        self.middle = pair(channels[-1], channels[-1])
        # On the way up every resolution sees what left it on the way down beside what comes from below.
        below = [*channels[1:], channels[-1]]
        self.up = nn.ModuleList(
            pair(width + lower, width) for width, lower in zip(channels, below, strict=True)
        )
        self.final = nn.Conv1d(channels[0], action_dim, 1)

    def forward(self, x: Tensor, step: Tensor, obs: Tensor) -> Tensor:
        """The noise in `x`.

        Args:
            x: Noisy normalised actions, shape (B, T_a, n_a).
            step: Noise level, counted from zero, shape (B,).
            obs: Normalised observations, shape (B, T_o, n).

        Returns:
            Shape (B, T_a, n_a).
        """
        condition = torch.cat([self.embed_step(step.to(x.dtype)), self.encode(obs.flatten(1))], dim=-1)
        x = x.transpose(1, 2)
        skips = []
        for level, blocks in enumerate(self.down):
            x = _through(blocks, x, condition)
            skips.append(x)
            if level < len(self.halve):
                x = self.halve[level](x)
        x = _through(self.middle, x, condition)
        for blocks, skip in zip(reversed(self.up), reversed(skips), strict=True):
            x = F.interpolate(x, size=skip.shape[-1])
            x = _through(blocks, torch.cat([x, skip], dim=1), condition)
        return self.final(x).transpose(1, 2)


def _through(blocks: nn.Module, x: Tensor, condition: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x, condition)
    return x
