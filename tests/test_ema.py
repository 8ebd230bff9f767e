"""The moving average follows its network as the formula says, and is not trained."""

import pytest
import torch

from lerobot_mimicik.ema import ExponentialAverage


@pytest.mark.parametrize("first_step", [0, 50, 100_000])
def test_average_is_the_formula_and_needs_no_gradient(first_step):
    network = torch.nn.Linear(2, 3)
    average = ExponentialAverage(network, decay=0.9)
    expected = network.weight.detach().clone()
    for step in range(first_step, first_step + 5):
        with torch.no_grad():
            network.weight += 1
        average.update(network, step)
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * network.weight
    torch.testing.assert_close(average.network.weight, expected.detach())
    assert not any(p.requires_grad for p in average.parameters())


def test_average_starts_at_the_weights_and_is_saved():
    network = torch.nn.Linear(2, 3)
    average = ExponentialAverage(network, decay=0.9)
    assert torch.equal(average.network.weight, network.weight)
    assert set(average.state_dict()) == {"network.weight", "network.bias"}


def test_little_of_the_untrained_weights_is_left_after_a_short_run():
    network = torch.nn.Linear(1, 1)
    average = ExponentialAverage(network, decay=0.995)
    with torch.no_grad():
        average.network.weight.fill_(1.0)
        network.weight.fill_(0.0)
    for step in range(300):
        average.update(network, step)
    assert average.network.weight.item() < 1e-6
