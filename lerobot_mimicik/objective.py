"""Training objectives and their inference: MIP, conditional flow matching and plain regression.

All three train the same network f(x, s, t | o) on normalised actions. A new objective is one class and
one entry in `OBJECTIVES`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.network import FlowGenerator


class Objective[Network: nn.Module](ABC):
    """How a network is supervised and how an action is drawn from it.

    Attributes:
        name: What its loss is called in the log.
        draws: Standard normal vectors of an action's width that drawing an action takes.
        random: Whether an action depends on them.
        times: All (s, t) at which drawing an action asks a `FlowGenerator`.
    """

    name: str
    draws: int = 1
    random: bool = False
    times: tuple[tuple[float, float], ...] = ()

    @abstractmethod
    def loss(self, network: Network, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Loss of each sample, squared L2 summed over action dimensions, shape (B,).

        Args:
            network: What is trained.
            obs: Normalised observations, shape (B, T_o, n).
            action: Normalised recorded actions, shape (B, n_a).
            noise: Standard normal, shape (B, draws * n_a).
            time: Uniform in [0, 1), shape (B,).
        """

    @abstractmethod
    def predict(self, network: Network, obs: Tensor, noise: Tensor) -> Tensor:
        """Normalised action for each observation, shape (B, n_a); differentiable.

        Args:
            network: What was trained.
            obs: Normalised observations, shape (B, T_o, n).
            noise: Where a generative objective starts, standard normal, shape (B, draws * n_a).
        """


def squared_norm(x: Tensor) -> Tensor:
    """Squared L2 over action dimensions, (*, n_a) -> (*,)."""
    return x.square().sum(dim=-1)


class MinimalIterativePolicy(Objective[FlowGenerator]):
    """Two supervised refinement steps (Pan et al. 2025, "Much Ado About Noising").

    loss = |f(0, 0, 0 | o) - a|^2 / t*^2 + |f(a + (1 - t*) z, t*, t* | o) - a|^2 / (1 - t*)^2
    a0 = f(0, 0, 0 | o),  a1 = f(a0, t*, t* | o)

    The paper's velocity step x1 = x0 + alpha v(x0, o, s) is the same map with v = (f - x0) / alpha.
    """

    name = "mip"

    def __init__(self, t_star: float = 0.9):
        self.t_star = t_star
        self.times = ((0.0, 0.0), (t_star, t_star))

    def loss(
        self, network: FlowGenerator, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        t_star, tokens = self.t_star, network.encode(obs)
        first = network(torch.zeros_like(action), 0.0, 0.0, tokens)
        second = network(action + (1 - t_star) * noise, t_star, t_star, tokens)
        return squared_norm(first - action) / t_star**2 + squared_norm(second - action) / (1 - t_star) ** 2

    def predict(self, network: FlowGenerator, obs: Tensor, noise: Tensor) -> Tensor:
        tokens = network.encode(obs)
        first = network(torch.zeros_like(noise), 0.0, 0.0, tokens)
        return network(first, self.t_star, self.t_star, tokens)


class FlowMatching(Objective[FlowGenerator]):
    """Conditional flow matching along straight lines; inference is Euler integration from noise."""

    name = "flow"
    random = True

    def __init__(self, n_steps: int = 10):
        self.n_steps = n_steps
        self.times = tuple((i * (1 / n_steps),) * 2 for i in range(n_steps))

    def loss(
        self, network: FlowGenerator, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        x = torch.lerp(noise, action, time.unsqueeze(-1))
        velocity = network(x, time, time, network.encode(obs))
        return squared_norm(velocity - (action - noise))

    def predict(self, network: FlowGenerator, obs: Tensor, noise: Tensor) -> Tensor:
        tokens, x, step = network.encode(obs), noise, 1 / self.n_steps
        for i in range(self.n_steps):
            x = x + step * network(x, i * step, i * step, tokens)
        return x


class Regression(Objective[FlowGenerator]):
    """One deterministic step a = f(0, 0, 0 | o), under a squared error."""

    name = "regression"
    times = ((0.0, 0.0),)

    def loss(
        self, network: FlowGenerator, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        return squared_norm(self.predict(network, obs, noise) - action)

    def predict(self, network: FlowGenerator, obs: Tensor, noise: Tensor) -> Tensor:
        return network(torch.zeros_like(noise), 0.0, 0.0, network.encode(obs))


OBJECTIVES: dict[str, Callable[[MimicIKConfig], Objective]] = {
    "mip": lambda config: MinimalIterativePolicy(config.t_star),
    "flow": lambda config: FlowMatching(config.flow_steps),
    "regression": lambda config: Regression(),
}
