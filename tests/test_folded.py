"""Exact algebra answers as the plain network does, for every objective and any number of rows."""

import pytest
import torch

from lerobot_mimicik.inference.folded import FoldedGenerator
from lerobot_mimicik.network import FlowGenerator, ObservationEncoder, SuDeepDiT
from lerobot_mimicik.objective import FlowMatching, MinimalIterativePolicy, Regression


@pytest.fixture
def network():
    torch.manual_seed(0)
    made = FlowGenerator(
        ObservationEncoder(2, 19, 32), SuDeepDiT(2, 6, d_model=32, n_layers=3, n_heads=4, d_ff=64)
    )
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.normal_(std=0.2)
    return made.double().eval()


@pytest.mark.parametrize(
    "objective", [MinimalIterativePolicy(), FlowMatching(4), Regression()], ids=lambda each: each.name
)
@pytest.mark.parametrize("rows", [1, 5])
def test_same_answer_as_the_plain_network(network, objective, rows):
    obs, noise = torch.randn(rows, 2, 19, dtype=torch.float64), torch.randn(rows, 6, dtype=torch.float64)
    folded = FoldedGenerator(network, objective.times)
    with torch.no_grad():
        expected = objective.predict(network, obs, noise)
        assert expected.abs().max() > 0.1
        torch.testing.assert_close(objective.predict(folded, obs, noise), expected, rtol=0, atol=1e-10)


def test_the_networks_own_weights_stay_as_they_are(network):
    before = {name: value.clone() for name, value in network.state_dict().items()}
    FoldedGenerator(network, ((0.0, 0.0),))
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())


def test_other_times_are_refused(network):
    folded = FoldedGenerator(network, ((0.0, 0.0),))
    with pytest.raises(KeyError):
        folded(torch.zeros(1, 6).double(), 0.5, 0.5, folded.encode(torch.zeros(1, 2, 19).double()))
