"""Datasets written at once are datasets to LeRobot."""

import json

import numpy as np
import pytest

from lerobot_mimicik.data.writer import Episode, episode_statistics, read_arm_json, write_dataset
from lerobot_mimicik.kinematics.arms import describe_arm

ARM = describe_arm("airbot_play", tool_offset=(0.1594, 0.0, 0.0))


def _episode(seed: int, gripper: bool = False) -> Episode:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(11 + seed, 6))
    pose = rng.normal(size=(11 + seed, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return Episode(
        q[:-1], q[1:], pose[:-1], pose[1:], f"task {seed % 2}", f"session {seed}",
        rng.uniform(size=(10 + seed, 2)) if gripper else None,
    )  # fmt: skip


@pytest.mark.parametrize("gripper", [False, True])
def test_lerobot_reads_back_what_was_written(tmp_path, gripper):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    episodes = [_episode(seed, gripper) for seed in range(3)]
    totals = write_dataset(tmp_path / "set", "local/set", iter(episodes), ARM, robot_type="airbot_play")
    assert totals == {"episodes": 3, "frames": 10 + 11 + 12}
    dataset = LeRobotDataset("local/set", root=tmp_path / "set", delta_timestamps={"action": [0.0, 0.05]})
    assert len(dataset) == 33
    assert dataset.meta.total_episodes == 3
    assert [row["session"] for row in dataset.meta.episodes] == ["session 0", "session 1", "session 2"]
    assert dataset.features["action"]["names"][-1] == ("gripper.pos" if gripper else "joint6.pos")
    row = dataset[10 + 4]
    second = episodes[1]
    assert row["task"] == "task 1"
    assert int(row["episode_index"]) == 1
    assert float(row["timestamp"]) == pytest.approx(0.2)
    np.testing.assert_allclose(row["observation.state"][:6], second.state[4], rtol=1e-6)
    np.testing.assert_allclose(row["action"][:, :6], second.action[4:6], rtol=1e-6)
    if gripper:
        assert float(row["observation.state"][6]) == pytest.approx(second.gripper[4, 0])
        assert float(row["action"][0, 6]) == pytest.approx(second.gripper[4, 1])
    sign = np.sign(second.ee_target[4, 6])
    np.testing.assert_allclose(row["observation.ee_target"][3:], sign * second.ee_target[4, 3:], rtol=1e-5)


def test_statistics_are_lerobots_with_exact_quantiles():
    from lerobot.datasets.compute_stats import compute_episode_stats

    rng = np.random.default_rng(0)
    columns = {"action": rng.uniform(size=(20000, 6)).astype(np.float32), "index": np.arange(20000)}
    features = {"action": {"dtype": "float32", "shape": (6,)}, "index": {"dtype": "int64", "shape": (1,)}}
    found, expected = episode_statistics(columns), compute_episode_stats(columns, features)
    assert found.keys() == expected.keys()
    for key, entry in expected.items():
        assert found[key].keys() == entry.keys()
        for name, value in entry.items():
            assert found[key][name].shape == value.shape
            # A bin of LeRobot's histogram is a 5,000th of the range.
            np.testing.assert_allclose(found[key][name], value, atol=1e-3 * np.ptp(columns[key]))


def test_stored_statistics_are_those_of_all_frames(tmp_path):
    episodes = [_episode(seed) for seed in range(4)]
    write_dataset(tmp_path / "set", "local/set", episodes, ARM)
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    actions = np.concatenate([episode.action for episode in episodes])
    np.testing.assert_allclose(stats["action"]["mean"], actions.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["action"]["std"], actions.std(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["action"]["max"], actions.max(axis=0), atol=1e-6)


def test_the_arm_comes_back(tmp_path):
    write_dataset(tmp_path / "set", "local/set", [_episode(0)], ARM)
    assert read_arm_json(tmp_path / "set") == ARM
    with pytest.raises(FileNotFoundError, match="for which arm"):
        read_arm_json(tmp_path)


def test_an_existing_dataset_is_kept_unless_told_otherwise(tmp_path):
    write_dataset(tmp_path / "set", "local/set", [_episode(0)], ARM)
    with pytest.raises(FileExistsError, match="exists already"):
        write_dataset(tmp_path / "set", "local/set", [_episode(1)], ARM)
    assert write_dataset(tmp_path / "set", "local/set", [_episode(1)], ARM, overwrite=True)["frames"] == 11


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda e: setattr(e, "action", e.action[:-1]),
            r"episode 0 \(session 'session 0'\): action must have shape",
        ),
        (lambda e: e.state.__setitem__((3, 2), np.nan), "state is not finite at frame 3"),
        (lambda e: e.ee_target.__setitem__((1, slice(3, 7)), 0.0), "quaternion of norm 0"),
    ],
)
def test_a_bad_episode_is_named_and_leaves_nothing(tmp_path, spoil, message):
    episode = _episode(0)
    spoil(episode)
    with pytest.raises(ValueError, match=message):
        write_dataset(tmp_path / "set", "local/set", [episode], ARM)
    assert list(tmp_path.iterdir()) == []


def test_no_episodes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no episode"):
        write_dataset(tmp_path / "set", "local/set", [], ARM)
