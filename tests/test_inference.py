"""The traced query answers as the policy does, whatever the objective and conditioning."""

import numpy as np
import pytest
import torch

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.inference.traced import TracedPolicy
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy


@pytest.mark.parametrize("objective", ["mip", "flow", "regression"])
@pytest.mark.parametrize("conditioning", ["relative", "paper"])
def test_same_answer_as_the_policy(objective, conditioning):
    torch.manual_seed(0)
    config = MimicIKConfig(
        d_model=16,
        n_layers=2,
        n_heads=2,
        d_ff=32,
        objective=objective,
        conditioning=conditioning,
        device="cpu",
    )
    policy = MimicIKPolicy(config).eval()
    with torch.no_grad():
        for parameter in policy.average.network.parameters():
            parameter.normal_(std=0.05)
    traced, rng = TracedPolicy(policy), np.random.default_rng(1)
    for _ in range(5):
        q = rng.uniform(policy.arm.lower, policy.arm.upper, (2, 6))
        target = policy.arm.forward(torch.as_tensor(q + 0.05, dtype=torch.float32)).double().numpy()
        target[0, 3:] *= -1  # either half-sphere
        expected = policy.predict_joints(
            torch.as_tensor(q[None], dtype=torch.float32), torch.as_tensor(target[None], dtype=torch.float32)
        )
        np.testing.assert_allclose(traced(q, target), expected[0].numpy(), atol=2e-4)


def test_never_pushes_joints_further_out_of_their_limits():
    policy = MimicIKPolicy(MimicIKConfig(d_model=16, n_layers=1, n_heads=2, d_ff=16, device="cpu")).eval()
    with torch.no_grad():
        for parameter in policy.average.network.parameters():
            parameter.normal_()
    upper = policy.arm.upper.double().numpy()
    q = np.stack([upper + 0.01, upper + 0.01])
    target = policy.arm.forward(torch.as_tensor(q, dtype=torch.float32)).double().numpy()
    assert (TracedPolicy(policy)(q, target) <= upper + 0.01 + 1e-12).all()
