"""Reading recordings of many layouts."""

import numpy as np
import pandas as pd
import pytest
from hand_recordings import hand_motion, hand_table
from lerobot.datasets import LeRobotDataset
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.retargeting.recordings import SourceColumns, load_recordings
from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.kinematics.arms import describe_arm


def _assert_poses(found: np.ndarray, expected: np.ndarray, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=atol)
    np.testing.assert_allclose(
        np.abs((found[:, 3:] * expected[:, 3:]).sum(axis=1)), 1.0, atol=max(atol, 1e-9)
    )


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_is_cut_into_its_groups(tmp_path, suffix):
    table = hand_table(4)
    path = tmp_path / f"hands{suffix}"
    table.to_parquet(path) if suffix == ".parquet" else table.to_csv(path, index=False)
    recordings = load_recordings(path)
    assert [r.name for r in recordings] == [f"session=s{i % 3}/episode={i}" for i in range(4)]
    assert [r.session for r in recordings] == [f"session=s{i % 3}" for i in range(4)]
    for index, recording in enumerate(recordings):
        t, pose = hand_motion(index)
        np.testing.assert_allclose(recording.t - recording.t[0], t, atol=1e-9)
        _assert_poses(recording.pose, pose)


def test_numbers_that_name_a_recording_stay_as_written(tmp_path):
    table = hand_table(2).assign(session=7)
    table.to_parquet(tmp_path / "hands.parquet")
    assert [r.name for r in load_recordings(tmp_path / "hands.parquet")] == [
        "session=7/episode=0",
        "session=7/episode=1",
    ]


def test_a_folder_of_tables_is_one_source(tmp_path):
    for index in (1, 0):
        hand_table(1)[["t", "x", "y", "z", "qx", "qy", "qz", "qw"]].to_csv(
            tmp_path / f"{index}.csv", index=False
        )
    assert [recording.name for recording in load_recordings(tmp_path)] == ["0.csv", "1.csv"]


def test_umi_style_columns(tmp_path):
    t, pose = hand_motion(0)
    pd.DataFrame(
        {
            "timestamp": t,
            "robot0_eef_pos": list(pose[:, :3]),
            "robot0_eef_rot_axis_angle": list(Rotation.from_quat(pose[:, 3:]).as_rotvec()),
            "robot0_gripper_width": np.linspace(0, 0.08, len(t)),
        }
    ).to_parquet(tmp_path / "umi.parquet")
    recording = load_recordings(tmp_path / "umi.parquet")[0]
    _assert_poses(recording.pose, pose)
    assert recording.gripper is not None
    assert recording.gripper[-1] == pytest.approx(0.08)


def test_names_orders_and_units_can_be_given(tmp_path):
    t, pose = hand_motion(0)
    table = pd.DataFrame(pose[:, [0, 1, 2, 6, 3, 4, 5]], columns=["a", "b", "c", "w", "i", "j", "k"])
    table["clock"] = (1_700_000_000_000 + 1000 * t).astype(np.int64)
    table["what"] = "pour"
    table.to_parquet(tmp_path / "odd.parquet")
    columns = SourceColumns(
        time="clock",
        position=("a", "b", "c"),
        rotation=("w", "i", "j", "k"),
        quaternion_order="wxyz",
        task="what",
    )
    recording = load_recordings(tmp_path / "odd.parquet", columns)[0]
    np.testing.assert_allclose(recording.t, t, atol=1e-3)
    _assert_poses(recording.pose, pose)
    assert recording.task == "pour"


def test_a_lerobot_dataset_with_poses(tmp_path):
    description = describe_arm("airbot_play")
    poses = [hand_motion(seed)[1] for seed in range(2)]
    joints = np.zeros((len(poses[0]), 6))
    grip = np.tile(np.linspace(0, 0.05, len(joints))[:, None], 2)
    episodes = [
        Episode(joints, joints, pose, pose, f"task {i}", f"session {i}", grip) for i, pose in enumerate(poses)
    ]
    write_dataset(tmp_path / "set", "local/set", episodes, description)
    recordings = load_recordings(tmp_path / "set")
    assert [(r.name, r.session, r.task) for r in recordings] == [
        (f"episode={i}", f"session {i}", f"task {i}") for i in range(2)
    ]
    for recording, pose in zip(recordings, poses, strict=True):
        _assert_poses(recording.pose, pose, atol=1e-6)
        assert recording.gripper is not None
        np.testing.assert_allclose(recording.gripper, grip[:, 0], atol=1e-6)


def test_a_lerobot_dataset_with_poses_beside_joints_as_the_airbot_plugin_names_them(tmp_path):
    pose = hand_motion(0)[1].astype(np.float32)
    joints = [f"joint_{i}.pos" for i in range(1, 7)]
    names = [*joints, "gripper.pos", *(f"eef.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))]
    features = {"observation.state": {"dtype": "float32", "shape": (14,), "names": names}}
    dataset = LeRobotDataset.create("local/eef", 20, features, root=tmp_path / "eef", use_videos=False)
    for frame in pose:
        state = np.concatenate([np.zeros(7, np.float32), frame])
        dataset.add_frame({"observation.state": state, "task": "pour"})
    dataset.save_episode()
    dataset.finalize()
    (recording,) = load_recordings(tmp_path / "eef")
    _assert_poses(recording.pose, pose, atol=1e-6)
    assert recording.gripper is not None


@pytest.mark.parametrize(
    ("change", "columns", "message"),
    [
        (lambda t: t.drop(columns="qx"), SourceColumns(), "no rotation columns .* Its columns: .*qy"),
        (lambda t: t.drop(columns="t"), SourceColumns(), "no time column"),
        (
            lambda t: t,
            SourceColumns(groups=("person",)),
            "no group column 'person'; its columns: session, episode",
        ),
        (lambda t: t, SourceColumns(time="stamp"), "no time column 'stamp'"),
        (lambda t: t, SourceColumns(position=("x", "up")), "no column 'up'"),
        (lambda t: t, SourceColumns(position=("x", "y")), "position takes 1 or 3 columns"),
        (lambda t: t.assign(episode=[None, *t["episode"][1:]]), SourceColumns(), "'episode' has empty cells"),
        (lambda t: t.assign(x="near"), SourceColumns(), "do not hold numbers"),
        (lambda t: t.assign(t=t["t"] * 1e12), SourceColumns(), "no plausible frame time"),
        (lambda t: t.iloc[:0], SourceColumns(), "has no rows"),
    ],
)
def test_what_is_missing_is_named_and_what_exists_listed(tmp_path, change, columns, message):
    path = tmp_path / "hands.parquet"
    change(hand_table(2)).to_parquet(path)
    with pytest.raises(ValueError, match=message):
        load_recordings(path, columns)


def test_inputs_that_are_no_recordings_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.csv does not exist"):
        load_recordings(tmp_path / "nothing.csv")
    with pytest.raises(ValueError, match="neither a LeRobot dataset"):
        load_recordings(tmp_path)
    (tmp_path / "a.zarr").write_text("")
    with pytest.raises(ValueError, match="convert zarr"):
        load_recordings(tmp_path / "a.zarr")


def test_a_frame_rate_stands_in_for_stamps(tmp_path):
    hand_table(2).drop(columns="t").to_parquet(tmp_path / "h.parquet")
    recording = load_recordings(tmp_path / "h.parquet", SourceColumns(fps=30))[1]
    np.testing.assert_allclose(np.diff(recording.t), 1 / 30)
