"""The policy as LeRobot and as users see it."""

import math

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from teleop import write_teleop

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

SMALL = {"device": "cpu", "push_to_hub": False, "d_model": 32, "n_layers": 1, "n_heads": 2, "d_ff": 32}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=4, frames=30)


def prepared(root, episodes=None, **options):
    """Policy, preprocessor and one training batch, made as `lerobot-train` makes them."""
    config = MimicIKConfig(**SMALL, **options)
    offsets = [i / 20 for i in config.observation_delta_indices]
    keys = ("observation.state", "observation.ee_pose", "observation.ee_target")
    windows = dict.fromkeys(keys, offsets) | {"action": [i / 20 for i in config.action_delta_indices]}
    dataset = LeRobotDataset("local/teleop", root=root, episodes=episodes, delta_timestamps=windows)
    policy = make_policy(config, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    batch = next(iter(torch.utils.data.DataLoader(dataset, 64)))
    return policy, dataset, preprocessor(batch)


def randomised(policy):
    """Untrained networks answer zero; random weights make answers that depend on everything."""
    torch.manual_seed(0)
    for p in policy.network.parameters():
        torch.nn.init.normal_(p, std=0.2)
    policy.average.network.load_state_dict(policy.network.state_dict())
    return policy


@pytest.mark.parametrize("objective", ["mip", "flow", "regression"])
@pytest.mark.parametrize("conditioning", ["paper", "relative"])
@pytest.mark.parametrize("fk_update", ["separate", "joint"])
def test_training_step(root, objective, conditioning, fk_update):
    policy, _, batch = prepared(root, objective=objective, conditioning=conditioning, fk_update=fk_update)
    optimiser = torch.optim.AdamW(policy.get_optim_params(), 1e-3)
    losses = []
    policy.train()
    for _ in range(15):
        loss, log = policy.forward(batch)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        policy.update()
        losses.append(loss.item())
    assert all(math.isfinite(value) for value in losses)
    assert losses[-1] < losses[0]
    assert log["fk_loss"] > 0
    assert policy.training_step == 15


def test_evaluation_loss_is_repeatable_and_per_sample_losses_average_to_it(root):
    policy, _, batch = prepared(root)
    randomised(policy).eval()
    with torch.no_grad():
        mean, _ = policy.forward(batch)
        each, _ = policy.forward(batch, reduction="none")
    assert each.shape == (64,)
    torch.testing.assert_close(each.mean(), mean)


def test_commands_are_absolute_joints_in_the_datasets_units(root):
    policy, dataset, _ = prepared(root)
    policy.eval()
    observation = {
        k: dataset[5][k][-1:] for k in ("observation.state", "observation.ee_pose", "observation.ee_target")
    }
    middle = policy.delta.unnormalise(torch.zeros(6))
    torch.testing.assert_close(policy.select_action(observation), observation["observation.state"] + middle)
    chunk = policy.predict_action_chunk(observation)
    assert chunk.shape == (1, 1, 6)


def test_commands_never_leave_the_training_steps_nor_the_limits(root):
    policy, _, _ = prepared(root)
    randomised(policy)
    q = torch.rand(500, 6) * 7 - 3.5
    lower, upper = policy.arm.lower, policy.arm.upper
    command = policy.predict_joints(q, policy.arm.forward(torch.roll(q, 1, 0)))
    step = command - q
    assert (step >= policy.delta.lower - 1e-5).all()
    assert (step <= policy.delta.upper + 1e-5).all()
    assert (command >= torch.minimum(lower, q) - 1e-6).all()
    assert (command <= torch.maximum(upper, q) + 1e-6).all()


def test_history_since_reset_equals_a_given_history(root):
    policy, _, _ = prepared(root)
    randomised(policy)
    q = torch.randn(3, 2, 6) * 0.1
    target = policy.arm.forward(q + 0.02)
    policy.reset()
    first = policy.predict_joints(q[:, 0], target[:, 0])
    second = policy.predict_joints(q[:, 1], target[:, 1])
    torch.testing.assert_close(second, policy.predict_joints(q, target))
    repeated = policy.predict_joints(q[:, :1].expand(-1, 2, -1), target[:, :1].expand(-1, 2, -1))
    torch.testing.assert_close(first, repeated)
    policy.reset()
    torch.testing.assert_close(policy.predict_joints(q[:, 0], target[:, 0]), first)


def test_checkpoint_needs_no_dataset(root, tmp_path):
    policy, dataset, _ = prepared(root)
    randomised(policy)
    policy.save_pretrained(tmp_path / "checkpoint")
    again = MimicIKPolicy.from_pretrained(tmp_path / "checkpoint")
    q = dataset[0]["observation.state"][-1:]
    target = dataset[3]["observation.ee_target"][-1:]
    assert torch.equal(again.predict_joints(q, target), policy.predict_joints(q, target))
    assert again.config.urdf.lstrip().startswith("<")
    assert not list((tmp_path / "checkpoint").glob("*.urdf"))


def test_statistics_come_from_the_training_episodes_alone(tmp_path):
    root = write_teleop(tmp_path / "teleop", episodes=6, frames=30)
    policy, _, _ = prepared(root, episodes=[0, 2])
    rows = LeRobotDataset("local/teleop", root=root, episodes=[0, 2]).hf_dataset.with_format("torch")
    step = rows["action"][:] - rows["observation.state"][:]
    torch.testing.assert_close(policy.delta.lower, step.amin(0))
    torch.testing.assert_close(policy.delta.upper, step.amax(0))
    everything, _, _ = prepared(root)
    assert (everything.delta.lower <= policy.delta.lower).all()
    assert not torch.equal(everything.delta.lower, policy.delta.lower)


@pytest.mark.parametrize("target", ["action", "next_state"])
def test_target_joints_and_poses(root, target):
    """With no lag the next state is the command, and FK of either is the recorded pose."""
    policy, _, batch = prepared(root, target=target)
    by_column = policy._reader.training_frames(batch, policy.arm)
    policy.config.target_pose_recorded, policy.config.current_pose_key = False, None
    by_fk = policy._reader.training_frames(batch, policy.arm)
    valid = by_column.valid
    torch.testing.assert_close(by_fk.pose_target[valid], by_column.pose_target[valid], atol=2e-6, rtol=0)
    torch.testing.assert_close(by_fk.pose_current, by_column.pose_current, atol=2e-6, rtol=0)
    last = batch["index"].flatten() % 30 == 29
    assert torch.equal(valid, ~last if target == "next_state" else torch.ones_like(last))
    reached = policy.arm.forward(by_column.q_target[valid])
    torch.testing.assert_close(reached, by_column.pose_target[valid, -1], atol=2e-6, rtol=0)


def test_dataset_without_poses_in_degrees_with_a_gripper():
    joints = [f"joint_{i}.pos" for i in range(1, 7)]
    features = {
        "observation.state": {"dtype": "float32", "shape": (7,), "names": [*joints, "gripper.pos"]},
        "action": {"dtype": "float32", "shape": (6,), "names": ["a", "b", "c", "d", "e", "gripper.pos"]},
    }  # fmt: skip
    config = MimicIKConfig(**SMALL, target="next_state", joint_units="deg")
    config.set_dataset_feature_metadata(features)
    assert config.output_features["action"].shape == (7,)
    policy = randomised(MimicIKPolicy(config))
    q = torch.tensor([[0.1, -0.5, 1.0, 0.2, 0.5, 0.3]])
    state = torch.cat([torch.rad2deg(q), torch.tensor([[42.0]])], dim=-1)
    target = policy.arm.forward(q + 0.01)
    command = policy.select_action({"observation.state": state, "observation.ee_target": target})
    policy.reset()
    torch.testing.assert_close(torch.deg2rad(command[:, :6]), policy.predict_joints(q, target))
    assert command[0, 6] == 42.0
    policy.reset()
    with_gripper = torch.cat([target, torch.tensor([[17.0]])], dim=-1)
    command = policy.select_action({"observation.state": state, "observation.ee_target": with_gripper})
    assert command[0, 6] == 17.0


@pytest.mark.parametrize(
    ("q", "target", "message"),
    [
        (torch.zeros(2, 5), torch.zeros(2, 7), r"q: expected shape \(B, 6\)"),
        (torch.zeros(2, 3, 6), torch.zeros(2, 3, 7), "q: expected shape"),
        (torch.zeros(2, 6), torch.zeros(2, 6), "pose_target: expected shape"),
        (torch.full((1, 6), float("nan")), torch.zeros(1, 7), "q is not finite"),
        (torch.zeros(1, 6), torch.full((1, 7), float("inf")), "pose_target is not finite"),
    ],
)
def test_bad_observations_are_refused(q, target, message):
    policy = MimicIKPolicy(MimicIKConfig(**SMALL))
    with pytest.raises(ValueError, match=message):
        policy.predict_joints(q, target)


def test_changing_the_batch_without_reset_is_refused():
    policy = MimicIKPolicy(MimicIKConfig(**SMALL))
    policy.predict_joints(torch.zeros(2, 6), policy.arm.forward(torch.zeros(2, 6)))
    with pytest.raises(ValueError, match="reset"):
        policy.predict_joints(torch.zeros(3, 6), policy.arm.forward(torch.zeros(3, 6)))


def test_missing_target_pose_is_named():
    policy = MimicIKPolicy(MimicIKConfig(**SMALL))
    with pytest.raises(KeyError, match=r"observation\.ee_target"):
        policy.select_action({"observation.state": torch.zeros(1, 6)})


def test_fk_pass_without_an_optimiser_step_is_refused(root):
    policy, _, batch = prepared(root)
    policy.train()
    policy.forward(batch)
    with pytest.raises(RuntimeError, match="optimiser"):
        policy.update()
