"""Logs of an arm's joints as datasets."""

import json

import numpy as np
import pandas as pd
import pytest
from airbot_data import airbot_data

from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.data.joint_logs import LogColumns, write_joint_logs
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
