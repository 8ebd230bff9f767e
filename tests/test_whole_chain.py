"""Stock LeRobot commands on simulated arms of five, six and seven joints: a policy, a recording, its replay."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot_commands import run_here

from robot_adapters.wrapping import wrap_checkpoint

ARMS = ("so101", "piper", "panda")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
QUIET = "--play_sounds=false"


def robot(arm: str) -> list[str]:
    """Poses in front of a simulated arm whose time passes with its actions."""
    inner = {"type": "mimicik_sim", "arm": arm, "real_time": "false", "fps": "20", "gripper": "false"}
    return ["--robot.type=mimicik_ee", *(f"--robot.arm.{key}={value}" for key, value in inner.items())]


@pytest.fixture(scope="module")
def act_for_poses(act_run, tmp_path_factory):
    return wrap_checkpoint(str(act_run), None, tmp_path_factory.mktemp("wrapped") / "act_ee")


@pytest.mark.parametrize("arm", ARMS)
def test_a_policy_in_end_effector_space_is_rolled_out_and_the_arm_brought_back(act_for_poses, arm):
    output = run_here(
        "lerobot.scripts.lerobot_rollout",
        f"--policy.path={act_for_poses}",
        *robot(arm),
        "--fps=20",
        "--duration=2",
        "--device=cpu",
        QUIET,
    )
    assert "Rollout finished" in output
    assert "Returning robot to initial position" in output
    assert "Could not return" not in output


@pytest.mark.parametrize("arm", ARMS)
def test_recorded_from_a_teleoperator_then_replayed(arm, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    example = importlib.import_module("replay_recordings")
    example.write(example.recordings(arm, 40)["circle"], tmp_path / "poses", fps=20)
    dataset = ["--dataset.repo_id=local/recorded", f"--dataset.root={tmp_path / 'recorded'}"]
    run_here(
        "lerobot.scripts.lerobot_record",
        *robot(arm),
        "--teleop.type=recorded_motion",
        f"--teleop.dataset_root={tmp_path / 'poses'}",
        *dataset,
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=3",
        "--dataset.reset_time_s=0",
        "--dataset.fps=20",
        "--dataset.single_task=follow the recording",
        "--dataset.push_to_hub=false",
        QUIET,
    )
    frames = LeRobotDataset("local/recorded", root=tmp_path / "recorded").hf_dataset.with_format("numpy")[:]
    state = frames["observation.state"]
    assert np.abs(state[:, 1:3] - state[0, 1:3]).max() > 0.02  # it went round, as far as the machine kept up
    np.testing.assert_allclose(
        state[-1, :3], frames["action"][-1, :3], atol=0.02
    )  # and ended where it was told
    output = run_here("lerobot.scripts.lerobot_replay", *robot(arm), *dataset, "--dataset.episode=0", QUIET)
    assert "failed:" not in output
