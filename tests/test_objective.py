"""The objectives against their formulas, and that each learns what it says."""

import pytest
import torch

from lerobot_mimicik.network import FlowGenerator, ObservationEncoder, SuDeepDiT
from lerobot_mimicik.objective import FlowMatching, MinimalIterativePolicy, Regression


class LinearNetwork(torch.nn.Module):
    """f(x, s, t | o) = x + 10 s + 100 t + o: a network whose answers are known."""

    def encode(self, obs):
        return obs[:, -1]

    def forward(self, x, s, t, tokens):
        return x + 10 * torch.as_tensor(s).reshape(-1, 1) + 100 * torch.as_tensor(t).reshape(-1, 1) + tokens


def sample(batch=3, dof=2):
    torch.manual_seed(1)
    return torch.randn(batch, 1, dof), torch.randn(batch, dof), torch.randn(batch, dof), torch.rand(batch)


def test_mip_loss_is_the_formula():
    obs, action, noise, time = sample()
    o, t = obs[:, -1], 0.9
    first = o - action
    second = (action + (1 - t) * noise) + 10 * t + 100 * t + o - action
    expected = first.square().sum(-1) / t**2 + second.square().sum(-1) / (1 - t) ** 2
    loss = MinimalIterativePolicy(t).loss(LinearNetwork(), obs, action, noise, time)
    torch.testing.assert_close(loss, expected)


def test_mip_refines_its_own_first_answer():
    obs, _, noise, _ = sample()
    o = obs[:, -1]
    torch.testing.assert_close(
        MinimalIterativePolicy(0.9).predict(LinearNetwork(), obs, noise), o + 9 + 90 + o
    )


def test_flow_loss_is_the_formula():
    obs, action, noise, time = sample()
    x = (1 - time)[:, None] * noise + time[:, None] * action
    velocity = x + 110 * time[:, None] + obs[:, -1]
    expected = (velocity - (action - noise)).square().sum(-1)
    torch.testing.assert_close(FlowMatching().loss(LinearNetwork(), obs, action, noise, time), expected)


def test_flow_inference_is_euler_integration():
    obs, _, noise, _ = sample()
    x = noise
    for s in (0.0, 0.5):
        x = x + 0.5 * (x + 110 * s + obs[:, -1])
    torch.testing.assert_close(FlowMatching(n_steps=2).predict(LinearNetwork(), obs, noise), x)


@pytest.mark.parametrize("objective", [MinimalIterativePolicy(), FlowMatching(8), Regression()])
def test_learns_a_smooth_map(objective):
    torch.manual_seed(0)
    network = FlowGenerator(
        ObservationEncoder(1, 3, 32), SuDeepDiT(1, 2, d_model=32, n_layers=1, n_heads=4, d_ff=64)
    )
    optimiser = torch.optim.Adam(network.parameters(), 4e-3)
    for _ in range(300):
        obs = 2 * torch.rand(256, 1, 3) - 1
        action = 0.5 * torch.sin(2 * obs[:, 0, :2]) * obs[:, 0, 2:]
        loss = objective.loss(network, obs, action, torch.randn(256, 2), torch.rand(256)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    obs = 2 * torch.rand(512, 1, 3) - 1
    wanted = 0.5 * torch.sin(2 * obs[:, 0, :2]) * obs[:, 0, 2:]
    with torch.no_grad():
        error = (objective.predict(network, obs, torch.randn(512, 2)) - wanted).norm(dim=-1).mean()
    assert error < 0.35 * wanted.norm(dim=-1).mean()
