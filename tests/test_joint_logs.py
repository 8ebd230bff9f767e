"""Logs of an arm's joints as datasets."""

import json

import numpy as np
import pandas as pd
import pytest
from airbot_data import airbot_data
from lerobot.datasets import LeRobotDataset

from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.data.joint_logs import LogColumns, write_joint_logs
from lerobot_mimicik.data.writer import POSE_NAMES
from lerobot_mimicik.evaluation.evaluate import study
from lerobot_mimicik.evaluation.report import describe_recording
from lerobot_mimicik.evaluation.trajectories import load_trajectories
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.chain import SerialArm

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)
RATE = 200.0


def logged(seconds: float = 3.0, lag: float = 0.05) -> pd.DataFrame:
    """A log at 200 Hz: commands that swing around home, joints that follow `lag` later."""
    t = np.arange(0, seconds, 1 / RATE)
    swing = np.linspace(0.1, 0.3, len(HOME))
    columns = {"t": t}
    columns |= {f"q{i}": HOME[i - 1] + swing[i - 1] * np.sin(t - lag) for i in range(1, 7)}
    columns |= {f"q_des{i}": HOME[i - 1] + swing[i - 1] * np.sin(t) for i in range(1, 7)}
    return pd.DataFrame(columns)


def read(root):
    return load_trajectories(root, SerialArm(ARM)).trajectories


def poses(q):
    return array_chain(ARM).pose(np.asarray(q))


def test_the_state_is_what_was_measured_and_the_target_what_was_commanded_next(tmp_path):
    logged().to_parquet(tmp_path / "log.parquet")
    commands = LogColumns(commands=tuple(f"q_des{i}" for i in range(1, 7)))
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM, commands)
    (trajectory,) = read(tmp_path / "set")
    assert (summary.episodes, summary.frames) == (1, len(trajectory))
    assert len(trajectory) == pytest.approx(60, abs=1)
    time = np.arange(len(trajectory)) / 20
    swing = np.linspace(0.1, 0.3, len(HOME))
    np.testing.assert_allclose(trajectory.q, HOME + swing * np.sin(time - 0.05)[:, None], atol=1e-4)
    commanded = HOME + swing * np.sin(time + 0.05)[:, None]
    np.testing.assert_allclose(trajectory.target, poses(commanded), atol=1e-4)


def test_without_commands_the_next_measurement_is_the_target(tmp_path):
    log = logged()[["t", *(f"q{i}" for i in range(1, 7))]]
    log = log.rename(columns={f"q{i}": f"{name}.pos" for i, name in enumerate(ARM.joint_names, 1)})
    log.to_csv(tmp_path / "log.csv", index=False)
    write_joint_logs(tmp_path / "log.csv", tmp_path / "set", ARM)
    (trajectory,) = read(tmp_path / "set")
    following = poses(trajectory.q[1:])
    np.testing.assert_allclose(trajectory.target[:-1], following, atol=1e-4)


def test_a_lerobot_dataset_of_joints_in_degrees_becomes_one_of_poses(tmp_path):
    piper = describe_arm("piper")
    names = [*(f"joint_{i}.pos" for i in range(1, 7)), "gripper.pos"]
    # Some datasets' actions are those of another arm, the leader: the next state counts.
    features = {
        "observation.state": {"dtype": "float32", "shape": (7,), "names": names},
        "action": {"dtype": "float32", "shape": (2,), "names": ["shoulder_pan.pos", "gripper.pos"]},
    }
    recorded = LeRobotDataset.create("local/joints", 20, features, root=tmp_path / "joints", use_videos=False)
    way = np.linspace(0, 5, 60)[:, None] * np.ones(6) + np.degrees(piper.home)
    for q in way:
        state = np.array([*q, 90.0 + q[0]], dtype=np.float32)
        recorded.add_frame({"observation.state": state, "action": state[:2], "task": "pick"})
    recorded.save_episode()
    recorded.finalize()
    columns = LogColumns(units="deg")
    summary = write_joint_logs(tmp_path / "joints", tmp_path / "poses", piper, columns, space="ee")
    assert (summary.episodes, summary.frames) == (1, 59)
    written = LeRobotDataset("local/poses", root=tmp_path / "poses")
    assert written.features["action"]["names"] == [
        *(f"ee.{each}.pos" for each in POSE_NAMES),
        "ee.gripper.pos",
    ]
    assert written[0]["task"] == "pick"
    frames = written.hf_dataset.with_format("numpy")[:]
    state, action = frames["observation.state"], frames["action"]
    expected = array_chain(piper).pose(np.radians(way[:59]))
    np.testing.assert_allclose(state, np.column_stack([expected, 90.0 + way[:59, 0]]), atol=1e-4)
    np.testing.assert_allclose(action[:-1], state[1:], atol=1e-6)


def test_degrees_columns_of_any_name_and_groups(tmp_path):
    log = logged(2.0)
    joints = [f"q{i}" for i in range(1, 7)]
    log[joints] = np.degrees(log[joints])
    renamed = log[["t", *joints]].rename(columns={name: f"axis {name}" for name in joints})
    both = pd.concat([renamed.assign(episode=0), renamed.assign(episode=1)])
    both.to_parquet(tmp_path / "log.parquet")
    columns = LogColumns(joints=tuple(f"axis {name}" for name in joints), units="deg")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM, columns)
    assert summary.episodes == 2
    trajectories = read(tmp_path / "set")
    np.testing.assert_allclose(trajectories[1].q[0], logged().loc[0, joints], atol=1e-5)


def test_holes_cut_and_bad_rows_are_left_out(tmp_path):
    log = logged(4.0)
    log.loc[100:110, "q3"] = np.nan
    log.loc[150, "t"] = log.loc[140, "t"]
    log = log.drop(index=range(400, 500))
    log.to_parquet(tmp_path / "log.parquet")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM)
    assert summary.episodes == 2
    for trajectory in read(tmp_path / "set"):
        assert np.abs(np.diff(trajectory.q, axis=0)).max() < 0.03


@pytest.mark.parametrize(
    ("change", "columns", "message"),
    [
        (lambda log: log.drop(columns="q4"), {}, "no columns for the joints"),
        (lambda log: log, {"joints": ("q1", "q2")}, "2 columns given for 6 joints"),
        (lambda log: log, {"commands": ("a", "b", "c", "d", "e", "f")}, "no joint column 'a'"),
        (lambda log: log.head(20), {}, "holds no recording of at least 1 s"),
        (lambda log: log.drop(columns="t"), {}, "no time column"),
        (lambda log: log.head(0), {}, "has no rows"),
    ],
)
def test_logs_that_cannot_be_read_are_named(tmp_path, change, columns, message):
    change(logged()).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(ValueError, match=message):
        write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM, LogColumns(**columns))
    assert not (tmp_path / "set").exists()


def _faulty(log):
    """Ten rows of NaN (0.055 s at 200 Hz, more than a frame), a glitch far outside, and two degrees outside."""
    log.loc[100:109, "q3"] = np.nan
    log.loc[300, "q2"] = 40.0
    log.loc[400:409, "q3"] = ARM.joints()[2].upper + 0.035


def test_what_was_mended_is_said(tmp_path):
    log = logged(4.0)
    _faulty(log)
    log.to_parquet(tmp_path / "log.parquet")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM)
    said = str(summary)
    for line in (
        "10 rows without a finite number",
        "1 rows with a joint far outside its limits",
        "filled by interpolation: 0.06 s",
        "2 jumps of a joint",  # to the limit and back
        "joint3: 10 readings outside its limits, by 0.035 rad",
    ):
        assert line in said
    upper = np.array([joint.upper for joint in ARM.joints()])
    assert all((trajectory.q <= upper + 1e-6).all() for trajectory in read(tmp_path / "set"))
    assert json.loads((tmp_path / "set/meta/joint_log.json").read_text())["mended"]["glitches"] == 1


def test_servos_a_little_outside_their_limits_are_clipped_and_kept(tmp_path):
    log = logged(2.0)
    log["q1"] = ARM.joints()[0].lower - np.radians(4)
    log.to_parquet(tmp_path / "log.parquet")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM)
    assert "joint1: 400 readings outside its limits, by 0.070 rad" in str(summary)
    (trajectory,) = read(tmp_path / "set")
    np.testing.assert_allclose(trajectory.q[:, 0], ARM.joints()[0].lower, atol=1e-6)


def test_a_jump_within_a_frame_cuts_the_recording(tmp_path):
    log = logged(4.0)
    log.loc[400:, "q1"] -= 2.0
    log.to_parquet(tmp_path / "log.parquet")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM)
    assert summary.episodes == 2
    assert "1 jumps of a joint" in str(summary)
    assert all(np.abs(np.diff(trajectory.q, axis=0)).max() < 0.1 for trajectory in read(tmp_path / "set"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log, q: np.degrees(log[q]), r"as degrees the numbers would fit.*--columns\.joint_units"),
        (lambda log, q: log[q] + [0, 0, 5, 0, 0, 0], r"joint3 is .* far outside its limits.*--robot"),
    ],
)
def test_joints_in_another_unit_or_of_another_arm_are_refused(tmp_path, change, message):
    log = logged()
    joints = [f"q{i}" for i in range(1, 7)]
    log[joints] = change(log, joints)
    log.to_parquet(tmp_path / "log.parquet")
    with pytest.raises(ValueError, match=message):
        write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM)
    assert not (tmp_path / "set").exists()


def test_radians_taken_for_degrees_are_asked_about(tmp_path):
    logged().to_parquet(tmp_path / "log.parquet")
    summary = write_joint_logs(tmp_path / "log.parquet", tmp_path / "set", ARM, LogColumns(units="deg"))
    assert "are the readings in rad?" in str(summary)


@pytest.mark.parametrize("name", ["empty.csv", "binary.csv", "broken.parquet", "words.csv"])
def test_files_that_cannot_be_read_are_named(tmp_path, name):
    (tmp_path / "logs").mkdir()
    path = tmp_path / "logs" / name
    content = {"empty.csv": b"", "binary.csv": bytes(range(128, 256)) * 9, "broken.parquet": b"PAR1 no"}
    path.write_bytes(content.get(name, b""))
    if name == "words.csv":
        logged().astype({"q2": object}).assign(q2="fast").to_csv(path, index=False)
    with pytest.raises(ValueError, match=name) as refused:
        write_joint_logs(tmp_path / "logs", tmp_path / "set", ARM)
    if name == "words.csv":
        assert "column 'q2' holds 'fast' in row 0" in str(refused.value)


def test_reports_do_not_call_recorded_joints_synthetic(tmp_path, capsys):
    (tmp_path / "logs").mkdir()
    logged().to_parquet(tmp_path / "logs" / "log.parquet")
    arguments = ["--source=joints", f"--input={tmp_path / 'logs'}", f"--output={tmp_path / 'set'}"]
    assert make_dataset.main(arguments) == 0
    assert "recorded joints" in capsys.readouterr().out
    assert json.loads((tmp_path / "set/meta/joint_log.json").read_text())["files"] == ["log.parquet"]
    arm = SerialArm(ARM)
    recording = study(arm, load_trajectories(tmp_path / "set", arm))
    assert describe_recording(recording)["synthetic_labels"] is False


def test_real_logs_of_the_airbot_play(tmp_path):
    log = airbot_data("rollout.parquet")
    if log is None:
        pytest.skip("the recordings of an AIRBOT Play are not here")
    # The whole folder: one log of a rollout, two of an excitation with commands.
    summary = write_joint_logs(log.parent, tmp_path / "set", ARM)
    assert summary.episodes == 3
    trajectories = read(tmp_path / "set")
    assert summary.frames == pytest.approx(20 * (25 + 25 + 12.4), rel=0.02)
    for trajectory in trajectories:
        reached = poses(trajectory.q)
        # Each target is one frame of motion away: at its fastest the arm moved its tool at 0.8 m/s.
        assert 0.01 < np.linalg.norm(reached[:, :3] - trajectory.target[:, :3], axis=1).max() < 0.05
