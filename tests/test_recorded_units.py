"""End-effector recordings in other units, or with quaternions in another order, than they were read in."""

import dataclasses

import numpy as np
import pytest
from hand_recordings import hand_recording, hand_table

from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.data.retargeting.recorded_units import check_recordings
from lerobot_mimicik.data.retargeting.recordings import Recording, SourceColumns, load_recordings
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain

ARM = describe_arm("airbot_play")


def check(recordings, unit="m"):
    check_recordings(recordings, ARM, 5.0, unit, "hands.csv")


def scaled(factor: float, still: bool = False) -> list[Recording]:
    recordings = [hand_recording(seed) for seed in range(5)]
    for recording in recordings:
        recording.pose[:, :3] *= factor
        if still:  # half of the time
            recording.pose[20:, :3] = recording.pose[20, :3]
    return recordings


def test_hand_motion_in_metres_passes_even_with_a_tracker_that_jumps():
    recordings = scaled(1.0)
    for recording in recordings:
        recording.pose[::9, :3] += 800.0
        recording.pose[3] = np.nan
    check(recordings)
    check([hand_recording(0)][:0])


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (1000.0, "cm or mm"), (100.0, "cm")])
def test_another_unit_is_refused_with_the_option(factor, unit, still):
    with pytest.raises(ValueError, match=r"hands\.csv: read in m.*--columns\.position_unit") as refused:
        check(scaled(factor, still))
    assert unit.split()[-1] in str(refused.value)


def test_metres_read_as_millimetres_are_refused():
    with pytest.raises(ValueError, match="read in mm"):
        check(scaled(1e-3), "mm")


def test_a_table_in_millimetres_is_read_as_such_when_told_so(tmp_path):
    table = hand_table(2)
    in_metres = table[["x", "y", "z"]].to_numpy()
    table[["x", "y", "z"]] *= 1000
    table.to_csv(tmp_path / "hands.csv", index=False)
    found = load_recordings(tmp_path / "hands.csv", SourceColumns(position_unit="mm"))
    np.testing.assert_allclose(np.concatenate([r.pose[:, :3] for r in found]), in_metres, rtol=1e-9)
    check(found, "mm")
    with pytest.raises(ValueError, match="position_unit must be one of m, cm, mm"):
        SourceColumns(position_unit="inch")


@pytest.mark.parametrize("degrees", [False, True])
def test_quaternions_that_the_joints_contradict_are_refused(tmp_path, degrees):
    time = np.arange(60) / 20
    q = np.array(ARM.home) + 0.6 * np.sin(time[:, None] * [1.0, 1.2, 0.9, 1.4, 0.8, 1.1])
    pose = array_chain(ARM).pose(q)
    table = hand_table(1, seconds=3.0)[["t"]].assign(**dict(zip("xyz", pose[:, :3].T, strict=True)))
    table[["qx", "qy", "qz", "qw"]] = pose[:, [6, 3, 4, 5]]
    table[[f"{name}.pos" for name in ARM.joint_names]] = np.degrees(q) if degrees else q
    table.to_csv(tmp_path / "log.csv", index=False)
    arguments = ["--source=ee", f"--input={tmp_path / 'log.csv'}", f"--output={tmp_path / 'out'}"]
    read = load_recordings(tmp_path / "log.csv", SourceColumns(), ARM.joint_names)
    with pytest.raises(ValueError, match=r"order w x y z.*--columns\.quaternion_order"):
        check(read)
    assert make_dataset.main(arguments) == 2
    check(load_recordings(tmp_path / "log.csv", SourceColumns(quaternion_order="wxyz"), ARM.joint_names))
    check([dataclasses.replace(recording, joints=None) for recording in read])  # nothing contradicts


def test_millimetres_leave_nothing_behind(tmp_path, capsys):
    table = hand_table(2)
    table[["x", "y", "z"]] *= 1000
    table.to_csv(tmp_path / "hands.csv", index=False)
    arguments = ["--source=ee", f"--input={tmp_path / 'hands.csv'}", f"--output={tmp_path / 'out'}"]
    assert make_dataset.main(arguments) == 2
    assert "mm would be plausible" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["hands.csv"]
