"""A single query answers as the policy does, whatever the objective, the conditioning and the engine."""

import sys

import numpy as np
import pytest
import torch

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.inference.engine import EngineUnavailable
from lerobot_mimicik.inference.engines import ENGINES, make_engine
from lerobot_mimicik.inference.noise import query_normal
from lerobot_mimicik.inference.single import SingleQuery
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.noise import sample_normal


@pytest.mark.parametrize("objective", ["mip", "flow", "regression"])
@pytest.mark.parametrize("conditioning", ["relative", "paper"])
@pytest.mark.parametrize("engine", ENGINES)
def test_same_answer_as_the_policy(engine, objective, conditioning):
    torch.manual_seed(0)
    config = MimicIKConfig(
        d_model=16,
        n_layers=2,
        n_heads=2,
        d_ff=32,
        objective=objective,
        flow_steps=3,
        conditioning=conditioning,
        device="cpu",
    )
    policy = MimicIKPolicy(config).eval()
    with torch.no_grad():
        for parameter in policy.average.network.parameters():
            parameter.normal_(std=0.05)
    if engine == "onnx":
        pytest.importorskip("onnxruntime")
        pytest.importorskip("onnx")
    single, rng = SingleQuery.of(policy, engine), np.random.default_rng(1)
    for _ in range(5):
        q = rng.uniform(policy.arm.lower, policy.arm.upper, (2, 6))
        target = policy.arm.forward(torch.as_tensor(q + 0.05, dtype=torch.float32)).double().numpy()
        target[0, 3:] *= -1  # either half-sphere
        expected = policy.predict_joints(
            torch.as_tensor(q[None], dtype=torch.float32), torch.as_tensor(target[None], dtype=torch.float32)
        )
        np.testing.assert_allclose(single(q, target), expected[0].numpy(), atol=2e-4)


def test_never_pushes_joints_further_out_of_their_limits():
    policy = MimicIKPolicy(MimicIKConfig(d_model=16, n_layers=1, n_heads=2, d_ff=16, device="cpu")).eval()
    with torch.no_grad():
        for parameter in policy.average.network.parameters():
            parameter.normal_()
    upper = policy.arm.upper.double().numpy()
    q = np.stack([upper + 0.01, upper + 0.01])
    target = policy.arm.forward(torch.as_tensor(q, dtype=torch.float32)).double().numpy()
    assert (SingleQuery.of(policy)(q, target) <= upper + 0.01 + 1e-12).all()


def tiny_policy():
    torch.manual_seed(0)
    return MimicIKPolicy(MimicIKConfig(d_model=16, n_layers=1, n_heads=2, d_ff=16, device="cpu")).eval()


def test_auto_takes_the_fastest_engine_that_is_installed_and_agrees(monkeypatch):
    class Wrong:
        @staticmethod
        def make(policy):
            return lambda frames, noise: np.full(6, 0.01)

    class Missing:
        @staticmethod
        def make(policy):
            raise EngineUnavailable("no such library")

    monkeypatch.setitem(sys.modules, "wrong_engine", Wrong)
    monkeypatch.setitem(sys.modules, "missing_engine", Missing)
    table = {"missing": "missing_engine", "wrong": "wrong_engine"}
    table |= {name: ENGINES[name] for name in ("traced", "eager")}
    monkeypatch.setattr("lerobot_mimicik.inference.engines.ENGINES", table)
    policy = tiny_policy()
    assert make_engine(policy)[0] == "traced"
    with pytest.raises(ValueError, match="'wrong' disagrees with the policy"):
        make_engine(policy, "wrong")
    with pytest.raises(EngineUnavailable):
        make_engine(policy, "missing")
    with pytest.raises(ValueError, match="expected one of auto, missing, wrong, traced, eager, or a file"):
        make_engine(policy, "tarced")


@pytest.mark.parametrize("seed", [0, 3, 2**40 + 7])
def test_noise_in_numpy_is_the_noise_in_torch(seed):
    for query in (0, 1, 1000):
        ours = query_normal(13, seed=seed, query=query)
        theirs = sample_normal(torch.zeros(1, dtype=torch.int64), 13, seed=seed, step=query)
        np.testing.assert_allclose(ours, theirs.numpy(), atol=2e-6)
