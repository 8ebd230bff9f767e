"""The UNet diffusion baseline as LeRobot and the solver interface see it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from evaluation_cases import airbot, trajectory
from learned_policies import lerobot_train, losses_of_training, prepared, queries
from teleop import write_teleop

from lerobot_mimicik.baselines.configuration_unet import UNetConfig
from lerobot_mimicik.baselines.modeling_unet import Diffusion, UNetPolicy
from lerobot_mimicik.baselines.unet import ConditionalUNet
from lerobot_mimicik.checkpoints import load_policy
from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.solvers import make_solver

SIZES = {"channels": [16, 24], "condition_dim": 16, "n_groups": 4}
SMALL = {"device": "cpu", "push_to_hub": False, **SIZES}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=4, frames=30)


@pytest.mark.parametrize("fk_weight", [0.0, 0.1])
def test_training_lowers_the_loss(root, fk_weight):
    policy, batch = prepared(UNetConfig(**SMALL, fk_weight=fk_weight), root)
    losses = losses_of_training(policy, batch, 40)
    assert np.isfinite(losses).all()
    # Every step draws other noise levels, so single losses scatter.
    assert np.mean(losses[-10:]) < 0.8 * losses[0]


@pytest.mark.parametrize(("train_timesteps", "inference_steps"), [(100, 10), (10, 10), (20, 3)])
def test_sampling_is_diffusers_ddpm(train_timesteps, inference_steps):
    """Given the noise that its DDPM scheduler draws, the answers are the same."""
    torch.manual_seed(0)
    network = ConditionalUNet(8, 6, channels=[16, 24], n_groups=4, condition_dim=16)
    obs, start = torch.randn(3, 2, 4), torch.randn(3, 6)
    reference = DDPMScheduler(train_timesteps, beta_schedule="squaredcos_cap_v2", clip_sample=True)
    reference.set_timesteps(inference_steps)
    drawn = torch.Generator().manual_seed(5)
    with torch.no_grad():
        x = start
        for step in reference.timesteps:
            predicted = network(x.unsqueeze(1), step.expand(3), obs).squeeze(1)
            x = reference.step(predicted, step, x, generator=drawn).prev_sample
        again = torch.Generator().manual_seed(5)
        noise = [start, *(torch.randn(3, 6, generator=again) for _ in range(inference_steps - 1))]
        found = Diffusion(train_timesteps, inference_steps).predict(network, obs, torch.cat(noise, dim=-1))
    torch.testing.assert_close(found, x, atol=1e-5, rtol=1e-4)


def test_answers_depend_on_the_noise_and_on_nothing_else(root):
    policy, _ = prepared(UNetConfig(**SMALL), root)
    q, target = queries(policy)
    noise = torch.randn(2, 5, 10 * 6)
    answers = []
    for given in (noise[0], noise[0], noise[1]):
        policy.reset()
        answers.append(policy.predict_joints(q, target, noise=given))
    assert torch.equal(answers[0], answers[1])
    assert not torch.equal(answers[0], answers[2])
    policy.reset()
    alone = policy.predict_joints(q[:1], target[:1], noise=noise[0, :1])
    torch.testing.assert_close(alone, answers[0][:1])
    # Without given noise it is seeded: the same after every reset.
    policy.reset()
    first = policy.predict_joints(q, target)
    policy.reset()
    assert torch.equal(policy.predict_joints(q, target), first)


@pytest.mark.parametrize("horizon", [1, 2, 5, 8])
def test_the_network_keeps_the_horizon(horizon):
    network = ConditionalUNet(8, 6, channels=[16, 24, 32], n_groups=4, condition_dim=16)
    x = torch.randn(3, horizon, 6)
    noise = network(x, torch.tensor([0, 5, 99]), torch.randn(3, 2, 4))
    assert noise.shape == x.shape
    noise.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_it_is_as_large_as_mimicik():
    sizes = [
        sum(p.numel() for p in policy_class(config).network.parameters())
        for policy_class, config in (
            (UNetPolicy, UNetConfig(device="cpu", conditioning="paper")),
            (MimicIKPolicy, MimicIKConfig(device="cpu", conditioning="paper")),
        )
    ]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_checkpoint_needs_no_dataset_and_is_loaded_by_its_type(root, tmp_path):
    policy, batch = prepared(UNetConfig(**SMALL), root)
    losses_of_training(policy, batch, 3)
    policy.save_pretrained(tmp_path)
    again = load_policy(str(tmp_path))
    assert isinstance(again, UNetPolicy)
    policy.reset()
    assert torch.equal(again.predict_joints(*queries(again)), policy.predict_joints(*queries(policy)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inference_steps": 200}, "inference_steps=200: expected at most train_timesteps=100"),
        ({"channels": [20]}, r"channels=\[20\]: expected 1 to 16 multiples of n_groups=8"),
        ({"channels": []}, r"channels=\[\]"),
        ({"kernel_size": 4}, "kernel_size=4: expected an odd number"),
        ({"condition_dim": 3}, "condition_dim=3"),
    ],
)
def test_impossible_settings_name_themselves(options, message):
    with pytest.raises(ValueError, match=message):
        UNetConfig(device="cpu", **options)


def test_the_solver_answers_within_the_training_steps(root):
    policy, _ = prepared(UNetConfig(**SMALL), root)
    solver = make_solver("unet_diffusion", airbot(), policy=policy)
    assert solver.name == "unet_diffusion"
    one = trajectory(10)
    step = solver.solve_recorded(one.q, one.target) - one.q
    assert (step >= policy.delta.lower.numpy() - 1e-5).all()
    assert (step <= policy.delta.upper.numpy() + 1e-5).all()


def test_lerobot_train_trains_it(root, tmp_path):
    lerobot_train(
        "--policy.type=mimicik_unet", "--policy.channels=[8,16]", "--policy.condition_dim=8",
        f"--dataset.root={root}", f"--output_dir={tmp_path}/run", "--steps=3",
    )  # fmt: skip
    assert load_policy(f"{tmp_path}/run").training_step == 3


def test_small_recipe_has_the_budget_of_mimiciks():
    folder = Path(__file__).parent.parent / "configs"
    own, reference = (json.loads((folder / name).read_text()) for name in ("unet_small.json", "small.json"))
    assert {key: value for key, value in own.items() if key != "policy"} == {
        key: value for key, value in reference.items() if key != "policy"
    }
