"""What is known of the future reaches the solver: chunks of policies and of processor steps, robots, drives."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.data.teleoperation.session import SyntheticConfig
from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic
from lerobot_mimicik.kinematics.arms import describe_arm
from robot_adapters.adapter import IKStatus, MimicIKAdapter
from robot_adapters.processor_steps import EEActionToJoints, JointsToEEState
from robot_adapters.robots.airbot_play import AirbotPlayEE
from robot_adapters.robots.config_airbot_play import AirbotPlayEEConfig

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)
# Joints of a smooth motion from home and back.
WAVE = HOME + 0.15 * (1 - np.cos(np.linspace(0, 2 * np.pi, 40)))[:, None] * [1, 0.3, -0.4, 1, 0.5, -1]


@pytest.fixture(scope="module")
def targets() -> np.ndarray:
    return np.stack([fresh().forward(q) for q in WAVE])


def fresh() -> MimicIKAdapter:
    return MimicIKAdapter.for_arm(ARM)


def one_by_one(targets) -> np.ndarray:
    adapter, commands = fresh(), [HOME]
    for target in targets:
        commands.append(adapter.solve(commands[-1], target).q)
    return np.array(commands[1:])


# --- The adapter ---


def test_a_future_that_does_not_change_anything_is_none(targets):
    alone = fresh().solve(HOME, targets[5]).q
    no_pose = np.full((3, 7), np.nan)
    for upcoming in (None, [], targets[:0], no_pose):
        np.testing.assert_array_equal(fresh().solve(HOME, targets[5], upcoming).q, alone)
    # What comes after one that is no pose is not looked at either.
    broken = np.concatenate([targets[6:8], no_pose, targets[8:9]])
    known = fresh().solve(HOME, targets[5], targets[6:8]).q
    np.testing.assert_array_equal(fresh().solve(HOME, targets[5], broken).q, known)
    assert np.abs(known - alone).max() > 0
    with pytest.raises(ValueError, match=r"upcoming target poses of shape \(T, 7\)"):
        fresh().solve(HOME, targets[5], targets[6])


def test_a_plan_survives_being_told_what_it_commanded(targets):
    adapter, told = fresh(), fresh()
    q = HOME
    for t, target in enumerate(targets):
        wanted = adapter.solve(q, target, targets[t + 1 :]).q
        np.testing.assert_array_equal(told.solve(q, target, targets[t + 1 :]).q, wanted)
        told.commanded(wanted)
        assert (told._guidance._plan is not None) == (t + 1 < len(targets))
        q = wanted


# --- Policies ---


@pytest.mark.parametrize("used", [None, 12])
def test_what_follows_in_a_chunk_is_looked_at_also_where_it_is_not_used(targets, used):
    adapter, expected = fresh(), fresh()
    policy = adapter.wrap(lambda observation: targets, actions_per_chunk=used)
    q = HOME
    for t in range(used or len(targets)):
        wanted = expected.solve(q, targets[t], targets[t + 1 :]).q
        q = policy.select_action({"observation.state": q})
        np.testing.assert_array_equal(q, wanted)


@pytest.mark.parametrize("padding", [0.0, np.nan])
def test_padding_behind_the_poses_that_are_used_does_no_harm(targets, padding):
    chunk = np.stack([targets[0], targets[0], np.full(7, padding)])
    policy = fresh().wrap(lambda observation: chunk, actions_per_chunk=2)
    for _ in range(3):
        policy.select_action({"observation.state": HOME})
        assert policy.result.status is IKStatus.REACHED
    with pytest.raises(ValueError, match="actions_per_chunk=0"):
        fresh().wrap(lambda observation: chunk, actions_per_chunk=0)


class Queueing(torch.nn.Module):
    """A LeRobot policy with both ways to ask it, of which one hides the future."""

    asked = 0

    def select_action(self, batch):
        """The first pose of a chunk."""
        return self.predict_action_chunk(batch)[:, 0]

    def predict_action_chunk(self, batch):
        """Three poses, five millimetres apart in x."""
        self.asked += 1
        return batch["observation.state"][:, None] + 0.005 * torch.arange(1, 4)[:, None] * torch.eye(7)[0]


@pytest.mark.parametrize(("used", "asked"), [(None, 2), (2, 1)])
def test_a_lerobot_policy_is_asked_for_chunks_where_their_use_is_said(used, asked):
    adapter, lerobot = fresh(), Queueing()
    policy, q = adapter.wrap(lerobot, actions_per_chunk=used), HOME
    for step in (1, 2):
        q = policy.select_action({"observation.state": q})
        assert abs(adapter.forward(q)[0] - adapter.forward(HOME)[0] - 0.005 * step) < 1e-3
    assert lerobot.asked == asked


# --- Processor steps of wrapped checkpoints ---


@pytest.fixture
def steps() -> tuple[JointsToEEState, EEActionToJoints]:
    small = {"device": "cpu", "d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16}
    before = JointsToEEState(arm=ARM.to_json(), joint_units="rad")
    after = EEActionToJoints(policy=small, joint_units="rad")
    after.relative_step, after.adapter = before, fresh()  # no network: its random steps would be asked for
    return before, after


def observe(step, q) -> None:
    step.observation({"observation.state": torch.as_tensor(q)})


def answer(step, poses) -> np.ndarray:
    return step({TransitionKey.ACTION: torch.as_tensor(poses)})[TransitionKey.ACTION].numpy()


def test_a_chunk_is_solved_with_all_its_poses_in_view(steps, targets):
    before, after = steps
    observe(before, HOME)
    gripper = np.linspace(0, 0.07, len(targets))[:, None]
    chunk = answer(after, np.concatenate([targets, gripper], axis=1)[None])
    assert chunk.shape == (1, len(targets), 7)
    expected = [result.q for result in fresh().solve_chunk(HOME, targets)]
    np.testing.assert_allclose(chunk[0, :, :6], expected, atol=1e-5)
    np.testing.assert_array_equal(chunk[0, :, 6:], gripper)
    assert np.abs(chunk[0, :, :6] - one_by_one(targets)).max() > 1e-5


def test_poses_that_come_alone_are_solved_as_before(steps, targets):
    before, after = steps
    observe(before, HOME)  # asynchronous inference: one observation, then the chunk pose by pose
    commands = np.concatenate([answer(after, target[None]) for target in targets])
    np.testing.assert_allclose(commands, one_by_one(targets), atol=1e-5)
    with pytest.raises(ValueError, match="one arm at a time"):
        answer(after, targets[:3])


@pytest.mark.parametrize("at_once", [True, False])
def test_a_new_chunk_starts_where_the_arm_is_not_where_the_last_chunk_ended(steps, targets, at_once):
    """LeRobot asks for the next chunk while the last one is carried out."""
    before, after = steps
    observe(before, HOME)
    ask = (
        (lambda poses: answer(after, poses[None])[0])
        if at_once
        else (lambda poses: np.concatenate([answer(after, pose[None]) for pose in poses]))
    )
    first = ask(targets[:20])
    observe(before, first[5])
    second = ask(targets[6:26])
    reached = [
        np.linalg.norm(fresh().forward(q)[:3] - t[:3]) for q, t in zip(second, targets[6:], strict=False)
    ]
    assert max(reached) < 2e-3
    np.testing.assert_allclose(second[:14], first[6:], atol=0.01)


# --- Robots and drives ---


def test_a_robot_can_be_told_which_poses_follow(targets, tmp_path):
    config = AirbotPlayEEConfig(
        id="arm", calibration_dir=tmp_path, interface="virtual", real_time=False, gripper=False,
        rotation="rotation_vector", start=list(HOME),
    )  # fmt: skip
    robot = AirbotPlayEE(config)
    adapter = fresh()
    poses = [
        dict(zip(robot.pose_keys, robot.face.frames.to_policy(each).tolist(), strict=True))
        for each in targets
    ]
    robot.connect()
    try:
        measured = robot.arm.read().q
        robot.foresee(poses[1:6])
        robot.send_action(poses[0])
        expected = adapter.solve(measured, targets[0], targets[1:6])
        np.testing.assert_allclose(robot.ik_result.q, expected.q, atol=1e-3)
        assert robot.adapter._guidance._plan.shape == (6, 6)
        robot.send_action(poses[1])  # it held for one action
        assert robot.adapter._guidance._plan is None
        with pytest.raises(KeyError, match=r"ee\.x\.pos"):
            robot.foresee([{}])
    finally:
        robot.disconnect()


@pytest.fixture(scope="module")
def near_singular(tmp_path_factory) -> Path:
    """A dataset of one near-singular trajectory of 20 s."""
    folder, short = tmp_path_factory.mktemp("motion"), SyntheticConfig(ood_episodes=1, ood_s=20.0)
    make_synthetic(folder, 1, ARM, workers=1, test_share=0.0, config=short, progress=False)
    return folder / "ood"


@pytest.mark.parametrize("ahead", [0, 7])
def test_deploy_needs_no_checkpoint_and_tracks_through_singularities(near_singular, tmp_path, ahead):
    options = ["--real_time=false", f"--look_ahead={ahead}", "--payload=1.0", f"--output={tmp_path}"]
    assert main(["deploy", f"--dataset.root={near_singular}", *options]) == 0
    (row,) = json.loads((tmp_path / "report.json").read_text())["rows"]
    assert row["solver"] == ("guided_ahead" if ahead else "guided")
    assert (row["verdict"], row["frames"], row["estop"]) == ("Bounded", 400, 0)
    assert row["mean_mm"] <= 0.2
    summary = json.loads((tmp_path / "deployment.json").read_text())
    assert summary["events"] == {}
    assert summary["commands"] == {"accepted": 400}
    assert summary["ik"]["look_ahead"] == ahead


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--look_ahead=-1"], "--look_ahead=-1"),
        (["--payload=-1"], "--payload=-1.0: expected a mass in kg"),
        (["--payload=1", "--interface=socketcan"], "--payload is for the simulated arm"),
    ],
)
def test_deploy_names_an_option_that_does_not_fit(tmp_path, capsys, options, reason):
    assert main(["deploy", *options, f"--output={tmp_path}"]) != 0
    assert reason in capsys.readouterr().err
