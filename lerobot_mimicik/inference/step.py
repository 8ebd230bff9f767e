"""The pure step of a policy: frames and noise in, a joint step out. Every engine computes this and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from lerobot_mimicik.inference.folded import FoldedGenerator
from lerobot_mimicik.network import FlowGenerator

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


class JointStep(nn.Module):
    """Joints and poses to a joint step [rad], (dof,), from the averaged weights at construction time."""

    def __init__(self, policy: LearnedIKPolicy, fold: bool = False):
        """`fold` computes a flow generator by exact algebra; see `folded`."""
        super().__init__()
        self.network: nn.Module = policy.average.network
        self.conditioning, self.delta = policy.conditioning, policy.delta
        self.objective, self.clip = policy.objective, policy.config.clip_delta
        if fold and isinstance(self.network, FlowGenerator):
            self.network = FoldedGenerator(self.network, self.objective.times)

    def forward(self, frames: Tensor, noise: Tensor) -> Tensor:
        """The step of one query.

        Args:
            frames: q [rad], current and target pose side by side, oldest frame first, float64, (T_o, dof + 14).
            noise: What the objective draws, float32, (1, draws * dof).

        Returns:
            float64, (dof,).
        """
        q, current, target = frames.float().unsqueeze(0).split([frames.shape[-1] - 14, 7, 7], dim=-1)
        delta = self.objective.predict(self.network, self.conditioning(q, current, target), noise)
        return self.delta.unnormalise(delta.clamp(-1, 1) if self.clip else delta)[0].double()


def example_inputs(policy: LearnedIKPolicy) -> tuple[Tensor, Tensor]:
    """Frames and noise of the shapes that a policy takes, where its weights are: for tracing."""
    device, dof = policy.delta.lower.device, policy.config.dof
    frames = torch.zeros(policy.config.n_obs_steps, dof + 14, dtype=torch.float64)
    frames[:, [-8, -1]] = 1.0
    return frames.to(device), torch.zeros(1, policy.objective.draws * dof, device=device)
