"""A real teleoperation set of another arm: degrees, a gripper, no poses, and no usable commands."""

import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train
from lerobot_commands import run_here

from lerobot_mimicik.batches.loading import FrameTable
from lerobot_mimicik.batches.statistics import iterate_frames
from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.kinematics.rotations import pose_error
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from robot_adapters.wrapping import wrap_checkpoint


@pytest.fixture(scope="module")
def trained(shared_data, tmp_path_factory):
    """The recordings, and a small policy trained on all but their last episodes by LeRobot's own command."""
    root = shared_data("piper_teleop/meta/info.json").parents[1]
    output = tmp_path_factory.mktemp("piper") / "run"
    with pytest.MonkeyPatch.context() as patch:
        arguments = [
            "--policy.type=mimicik", "--policy.push_to_hub=false", "--policy.device=cpu", "--policy.urdf=piper",
            "--policy.joint_units=deg", "--policy.target=next_state", "--policy.d_model=48",
            "--policy.n_layers=1", "--policy.d_ff=96", "--policy.optimizer_lr=3e-3",
            "--dataset.repo_id=local/piper_teleop", f"--dataset.root={root}", "--dataset.eval_split=0.2",
            f"--output_dir={output}", "--batch_size=256", "--steps=150", "--num_workers=0", "--env_eval_freq=0",
        ]  # fmt: skip
        patch.setattr(sys, "argv", ["lerobot-train", *arguments])
        lerobot_train.main()
    return root, MimicIKPolicy.from_pretrained(output / "checkpoints" / "last" / "pretrained_model")


def test_statistics_are_those_of_the_arm_in_radians(trained):
    _, policy = trained
    joints = policy.conditioning.joints
    assert (joints.lower >= policy.arm.lower - 0.02).all()
    assert (joints.upper <= policy.arm.upper + 0.02).all()
    assert policy.delta.upper.abs().max() < math.pi / 4
    assert policy.conditioning.position.upper.abs().max() < 1.0, "the tool stays within a metre of the base"


def test_held_out_episodes_are_followed_better_than_by_holding_still(trained):
    root, policy = trained
    held_out = LeRobotDataset("local/piper_teleop", root=root, episodes=[15, 16, 17, 18])
    frames = next(iterate_frames(FrameTable(held_out), policy.config, policy.arm, chunk=100_000))
    moving = frames.valid & ((frames.q_target - frames.q[:, -1]).abs().amax(dim=-1) > math.radians(0.5))
    assert moving.sum() > 100
    command = policy.predict_joints(frames.q[moving], frames.pose_target[moving])
    target = frames.pose_target[moving, -1]
    error, _ = pose_error(policy.arm.forward(command), target)
    hold, _ = pose_error(policy.arm.forward(frames.q[moving, -1]), target)
    assert error.mean() < 0.6 * hold.mean()


def test_commands_come_in_degrees_with_the_gripper_passed_through(trained):
    root, policy = trained
    frame = LeRobotDataset("local/piper_teleop", root=root, episodes=[15])[40]
    state = frame["observation.state"][None]
    target = policy.arm.forward(torch.deg2rad(state[:, :6]))
    command = policy.select_action({"observation.state": state, "observation.ee_target": target})
    assert command.shape == (1, 7)
    assert (command[:, :6] - state[:, :6]).abs().max() < 10.0
    assert command[0, 6] == state[0, 6]


def test_it_becomes_poses_and_their_policy_drives_the_simulated_arm(shared_data, tmp_path, monkeypatch):
    root = shared_data("piper_teleop/meta/info.json").parents[1]
    options = ["--source=joints", "--space=ee", "--arm=piper", "--columns.joint_units=deg", "--fps=15"]
    assert make_dataset.main([*options, f"--input={root}", f"--output={tmp_path / 'poses'}"]) == 0
    run_here(
        "lerobot.scripts.lerobot_train",
        "--policy.type=act",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--policy.chunk_size=15",
        "--policy.n_action_steps=15",
        "--policy.dim_model=64",
        "--policy.n_heads=4",
        "--policy.dim_feedforward=128",
        "--policy.n_encoder_layers=1",
        "--policy.use_vae=false",
        "--policy.optimizer_lr=1e-3",
        "--dataset.repo_id=local/poses",
        f"--dataset.root={tmp_path / 'poses'}",
        f"--output_dir={tmp_path / 'act'}",
        "--batch_size=16",
        "--num_workers=0",
        "--steps=20",
        "--save_freq=20",
        "--env_eval_freq=0",
    )
    policy = wrap_checkpoint(str(tmp_path / "act"), None, tmp_path / "wrapped")
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[1] / "examples")
    observed = importlib.import_module("replay_recordings").ObservedSim
    output = run_here(
        "lerobot.scripts.lerobot_rollout",
        f"--policy.path={policy}",
        "--robot.type=mimicik_ee",
        "--robot.arm.type=observed_sim",
        "--robot.arm.arm=piper",
        "--robot.arm.real_time=false",
        "--fps=15",
        "--duration=2",
        "--device=cpu",
        "--play_sounds=false",
        "--return_to_initial_position=false",
    )
    assert "Rollout finished" in output
    commands = np.array(observed.commands)
    assert np.ptp(commands, axis=0).max() > 0.1
    assert np.abs(np.diff(commands, axis=0)).max() < 0.0951
