"""Sizes, shapes and start of the network."""

import pytest
import torch

from lerobot_mimicik.network import FlowGenerator, ObservationEncoder, SelfAttention, SuDeepDiT


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_sizes_are_the_papers():
    encoder, flow_map = ObservationEncoder(2, 20, 256), SuDeepDiT(2, 6)
    assert count(flow_map) == pytest.approx(16.2e6, rel=0.01)
    assert count(encoder) + count(flow_map) == pytest.approx(16.4e6, rel=0.01)
    assert round(count(encoder) / 1e6, 1) == 0.2


@pytest.mark.parametrize(
    ("batch", "obs_frames", "dof", "horizon", "d_model", "heads"), [(1, 1, 6, 1, 32, 1), (5, 3, 7, 4, 64, 4)]
)
def test_every_size_is_settable(batch, obs_frames, dof, horizon, d_model, heads):
    flow_map = SuDeepDiT(
        obs_frames, dof, horizon=horizon, d_model=d_model, n_layers=2, n_heads=heads, d_ff=48
    )
    tokens = ObservationEncoder(obs_frames, 11, d_model)(torch.randn(batch, obs_frames, 11))
    assert tokens.shape == (batch, obs_frames, d_model)
    answer = flow_map(torch.randn(batch, horizon, dof), torch.zeros(batch), torch.ones(batch), tokens)
    assert answer.shape == (batch, horizon, dof)


def test_untrained_network_answers_zero_and_every_weight_then_learns():
    torch.manual_seed(0)
    network = FlowGenerator(
        ObservationEncoder(2, 20, 32), SuDeepDiT(2, 6, d_model=32, n_layers=2, n_heads=2, d_ff=64)
    )
    obs, action = torch.randn(8, 2, 20), torch.randn(8, 6)
    assert torch.equal(network(action, 0.3, 0.7, network.encode(obs)), torch.zeros(8, 6))
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    for _ in range(4):  # zero-initialised layers pass gradients on one after the other
        optimiser.zero_grad()
        (network(action, 0.3, 0.7, network.encode(obs)) - action).square().mean().backward()
        optimiser.step()
    still = [name for name, p in network.named_parameters() if torch.equal(p, before[name])]
    assert all("query_key" in name for name in still), still


def test_answer_depends_on_both_times():
    torch.manual_seed(0)
    flow_map = SuDeepDiT(1, 6, d_model=32, n_layers=2, n_heads=2, d_ff=64)
    for p in flow_map.parameters():
        torch.nn.init.normal_(p, std=0.1)
    x, tokens = torch.randn(1, 1, 6), torch.randn(1, 1, 32)
    answers = [
        flow_map(x, torch.tensor([s]), torch.tensor([t]), tokens) for s, t in [(0, 0), (0, 0.9), (0.9, 0)]
    ]
    assert not torch.allclose(answers[0], answers[1])
    assert not torch.allclose(answers[0], answers[2])
    assert not torch.allclose(answers[1], answers[2])


def test_single_token_attention_is_what_full_attention_gives():
    torch.manual_seed(0)
    attention = SelfAttention(32, 4)
    token = torch.randn(3, 1, 32)
    twice = token.expand(-1, 2, -1)  # two equal tokens: softmax weights are one half each
    torch.testing.assert_close(attention(token), attention(twice)[:, :1])
