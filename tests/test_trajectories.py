"""Properties of reading trajectories from LeRobot datasets."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluation_cases import airbot, trajectory

from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.evaluation.trajectories import (
    Layout,
    Trajectory,
    TrajectorySet,
    distinct_names,
    first_seconds,
    load_trajectories,
)


def fk(q):
    return airbot().forward(torch.from_numpy(q)).numpy()


def write(root, lengths, gripper=False):
    """A dataset of smooth motion; returns its trajectories."""
    recorded = [trajectory(length, index=i) for i, length in enumerate(lengths)]
    episodes = [
        Episode(
            state=one.q,
            action=np.roll(one.q, -1, axis=0),
            ee_pose=fk(one.q),
            ee_target=one.target,
            task="move",
            session="s",
            gripper=np.zeros((len(one), 2)) if gripper else None,
        )
        for one in recorded
    ]
    write_dataset(root, "local/test", episodes, airbot().description)
    return recorded


@pytest.mark.parametrize("gripper", [False, True])
def test_what_was_written_is_read(tmp_path, gripper):
    recorded = write(tmp_path / "data", [12, 7, 20], gripper)
    found = load_trajectories(tmp_path / "data", airbot())
    assert (found.name, found.fps, found.frames) == ("data", 20.0, 39)
    for i, (one, expected) in enumerate(zip(found.trajectories, recorded, strict=True)):
        assert one.index == i
        np.testing.assert_allclose(one.q, expected.q, atol=1e-6)
        np.testing.assert_allclose(one.target, expected.target, atol=1e-6)


def test_episodes_are_chosen_by_number(tmp_path):
    write(tmp_path / "data", [12, 7, 20])
    found = load_trajectories(tmp_path / "data", airbot(), episodes=[2, 0])
    assert [(one.index, len(one)) for one in found.trajectories] == [(2, 20), (0, 12)]
    with pytest.raises(ValueError, match=r"no episode \[5\]; it has 0 to 2"):
        load_trajectories(tmp_path / "data", airbot(), episodes=[1, 5])


def test_without_a_pose_column_the_target_is_fk_of_the_target_joints(tmp_path):
    recorded = write(tmp_path / "data", [12])[0]
    by_action = load_trajectories(tmp_path / "data", airbot(), Layout(target_pose_key="observation.absent"))
    (one,) = by_action.trajectories
    np.testing.assert_allclose(one.target, fk(np.roll(recorded.q, -1, axis=0)), atol=1e-6)
    layout = Layout(target="next_state", target_pose_key="observation.absent")
    (one,) = load_trajectories(tmp_path / "data", airbot(), layout).trajectories
    assert len(one) == 11
    np.testing.assert_allclose(one.target, fk(recorded.q[1:]), atol=1e-6)


def test_degrees_are_read_as_radians(tmp_path):
    recorded = write(tmp_path / "data", [12])[0]
    (one,) = load_trajectories(tmp_path / "data", airbot(), Layout(joint_units="deg")).trajectories
    np.testing.assert_allclose(one.q, np.radians(recorded.q), atol=1e-6)


def test_a_folder_that_is_no_dataset_is_refused_with_those_nearby(tmp_path):
    write(tmp_path / "made" / "train", [5])
    with pytest.raises(FileNotFoundError, match=r"(?s)not a LeRobot dataset.*made/train"):
        load_trajectories(tmp_path / "made", airbot())


def test_a_missing_column_is_named_with_those_that_exist(tmp_path):
    write(tmp_path / "data", [5])
    path = tmp_path / "data" / "meta" / "info.json"
    info = json.loads(path.read_text())
    for key in ("action", "observation.ee_target"):
        del info["features"][key]
    path.write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"(?s)no column action; it has .*observation\.state"):
        load_trajectories(tmp_path / "data", airbot())


def test_datasets_are_called_by_as_little_of_their_path_as_tells_them_apart():
    assert distinct_names(["/a/x/test", "/a/y/test", "/a/ood"]) == ["x/test", "y/test", "ood"]
    assert distinct_names(["/a/test"]) == ["test"]


def test_shapes_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="Trajectory 3"):
        Trajectory(3, np.zeros((4, 6)), np.zeros((5, 7)))


def test_the_beginning_of_a_set():
    one = Trajectory(3, np.zeros((30, 6)), np.tile([0, 0, 0, 0, 0, 0, 1.0], (30, 1)))
    other = Trajectory(4, one.q[:10], one.target[:10])
    whole = TrajectorySet("set", Path("set"), 10.0, (one, other))
    assert [len(each) for each in first_seconds(whole).trajectories] == [30, 10]
    assert [len(each) for each in first_seconds(whole, of_each=2).trajectories] == [20, 10]
    assert [len(each) for each in first_seconds(whole, in_all=3.5).trajectories] == [30, 5]
    assert [each.index for each in first_seconds(whole, of_each=2, in_all=1).trajectories] == [3]
    with pytest.raises(ValueError, match="less than a frame"):
        first_seconds(whole, of_each=0.01)


def change_column(root, name, change):
    """Rewrites a column of a dataset's only file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (file,) = (root / "data").glob("*/*.parquet")
    table = pq.read_table(file)
    values = np.array(table[name].to_pylist())
    change(values)
    column = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), pa.float32()), values.shape[1])
    index = table.schema.get_field_index(name)
    pq.write_table(table.set_column(index, table.schema.field(index).with_type(column.type), column), file)


def test_numbers_that_are_not_finite_are_named_by_column_and_episode(tmp_path):
    write(tmp_path / "data", [12, 7])

    def spoil(values):
        values[15, 1] = np.nan

    change_column(tmp_path / "data", "observation.state", spoil)
    with pytest.raises(ValueError, match=r"observation\.state is not finite .* joint2 in episode 1, frame 3"):
        load_trajectories(tmp_path / "data", airbot())
    assert len(load_trajectories(tmp_path / "data", airbot(), episodes=[0]).trajectories) == 1


def test_degrees_read_as_radians_are_refused_with_the_option(tmp_path):
    write(tmp_path / "data", [12])

    def to_degrees(values):
        values[:] = np.degrees(values)

    change_column(tmp_path / "data", "observation.state", to_degrees)
    with pytest.raises(
        ValueError, match=r"as degrees the numbers would fit.*--joint_units=deg.*--policy\.joint_units=deg"
    ):
        load_trajectories(tmp_path / "data", airbot())


def test_another_arms_dataset_is_refused_unless_the_user_names_the_arm(tmp_path):
    from lerobot_mimicik.kinematics.arms import describe_arm

    write(tmp_path / "data", [5])
    (tmp_path / "data" / "meta" / "arm.json").write_text(describe_arm("piper").to_json())
    with pytest.raises(ValueError, match=r"another arm \(meta/arm\.json\) than it is read for"):
        load_trajectories(tmp_path / "data", airbot())
    assert load_trajectories(tmp_path / "data", airbot(), Layout(any_arm=True)).frames == 5
