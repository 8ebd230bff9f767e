"""Exponential moving average of a network's weights, kept inside the policy and so inside checkpoints."""

import copy

import torch
from torch import nn


class ExponentialAverage[Network: nn.Module](nn.Module):
    """A frozen copy of a network that follows it: average <- decay * average + (1 - decay) * weights.

    A young average would mostly be the untrained network, so the decay grows to its value as
    (1 + step) / (10 + step); with the paper's 0.995 that takes 1,790 steps of 300,000.
    """

    def __init__(self, network: Network, decay: float):
        super().__init__()
        self.decay = decay
        self.network: Network = copy.deepcopy(network).requires_grad_(False)

    @torch.no_grad()
    def update(self, network: Network, step: int) -> None:
        """Follows `network` after training step number `step`, counted from zero."""
        decay = min(self.decay, (1 + step) / (10 + step))
        averages = [average.detach() for average in self.network.parameters()]
        torch._foreach_lerp_(averages, [weight.detach() for weight in network.parameters()], 1 - decay)
