"""The pure MLP baseline as LeRobot and the solver interface see it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluation_cases import airbot, trajectory
from learned_policies import lerobot_train, losses_of_training, prepared, queries
from teleop import write_teleop

from lerobot_mimicik.baselines.configuration_mlp import MLPConfig
from lerobot_mimicik.baselines.modeling_mlp import MLPPolicy
from lerobot_mimicik.checkpoints import kind_of, load_policy
from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.solvers import make_solver

SMALL = {"device": "cpu", "push_to_hub": False, "hidden_dim": 32, "n_layers": 2}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=4, frames=30)


@pytest.mark.parametrize("fk_weight", [0.0, 0.1])
def test_training_lowers_the_loss(root, fk_weight):
    policy, batch = prepared(MLPConfig(**SMALL, fk_weight=fk_weight), root)
    losses = losses_of_training(policy, batch, 40)
    assert np.isfinite(losses).all()
    assert losses[-1] < 0.5 * losses[0]


def test_the_papers_baseline_has_no_fk_loss():
    assert MLPConfig(device="cpu").fk_weight == 0


def test_checkpoint_needs_no_dataset_and_is_loaded_by_its_type(root, tmp_path):
    policy, batch = prepared(MLPConfig(**SMALL), root)
    losses_of_training(policy, batch, 5)
    policy.save_pretrained(tmp_path)
    again = load_policy(str(tmp_path))
    assert isinstance(again, MLPPolicy)
    assert torch.equal(again.predict_joints(*queries(again)), policy.predict_joints(*queries(policy)))
    with pytest.raises(TypeError, match="expected a policy of type 'mimicik', got 'mimicik_mlp'"):
        MimicIKPolicy.from_pretrained(tmp_path)


def test_a_checkpoint_of_another_policy_is_refused_with_the_known_types(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"type": "act"}))
    with pytest.raises(ValueError, match=r"type 'act'.*mimicik, mimicik_mlp, mimicik_unet"):
        load_policy(str(tmp_path))


@pytest.mark.parametrize("option", ["hidden_dim", "n_layers"])
def test_impossible_sizes_name_themselves(option):
    with pytest.raises(ValueError, match=f"{option}=0"):
        MLPConfig(device="cpu", **{option: 0})


def test_the_solver_answers_within_the_training_steps(root):
    policy, batch = prepared(MLPConfig(**SMALL), root)
    losses_of_training(policy, batch, 3)
    solver = make_solver("mlp", airbot(), policy=policy)
    assert solver.name == "mlp"
    one = trajectory(10)
    step = solver.solve_recorded(one.q, one.target) - one.q
    assert (step >= policy.delta.lower.numpy() - 1e-5).all()
    assert (step <= policy.delta.upper.numpy() + 1e-5).all()
    with pytest.raises(ValueError, match="unet_diffusion needs a checkpoint of that kind; this one is mlp"):
        make_solver("unet_diffusion", airbot(), policy=policy)


def test_kinds_tell_mimicik_with_fk_loss_from_one_without():
    assert kind_of(MimicIKConfig(device="cpu")) == "mimicik"
    assert kind_of(MimicIKConfig(device="cpu", fk_weight=0.0)) == "mimicik_nofk"
    assert kind_of(MLPConfig(device="cpu", fk_weight=0.1)) == "mlp"


def test_lerobot_train_trains_it(root, tmp_path):
    lerobot_train(
        "--policy.type=mimicik_mlp", "--policy.hidden_dim=16", "--policy.n_layers=1",
        f"--dataset.root={root}", f"--output_dir={tmp_path}/run", "--steps=3",
    )  # fmt: skip
    assert load_policy(f"{tmp_path}/run").training_step == 3


def test_small_recipe_has_the_budget_of_mimiciks():
    folder = Path(__file__).parent.parent / "configs"
    own, reference = (json.loads((folder / name).read_text()) for name in ("mlp_small.json", "small.json"))
    assert {key: value for key, value in own.items() if key != "policy"} == {
        key: value for key, value in reference.items() if key != "policy"
    }
