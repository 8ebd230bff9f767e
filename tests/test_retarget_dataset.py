"""From a file of recordings to a dataset: splits, workers, resuming, lag."""

import json

import numpy as np
import pandas as pd
import pytest
from hand_recordings import hand_table

from lerobot_mimicik.data.retargeting import dataset as module
from lerobot_mimicik.data.retargeting.dataset import JobOptions, follow_command, retarget_dataset
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.trajectory_ik import forward

ARM = describe_arm("airbot_play")
QUIET = {"progress": False, "workers": 0}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("source") / "hands.parquet"
    hand_table(9, seconds=1.0).to_parquet(path)
    return path


@pytest.fixture
def small_batches(monkeypatch):
    monkeypatch.setattr(module, "_BATCH", 2)


def _frames(root) -> pd.DataFrame:
    return pd.read_parquet(root / "data" / "chunk-000" / "file-000.parquet")


def _column(frames: pd.DataFrame, name: str) -> np.ndarray:
    return np.stack(frames[name].to_numpy()).astype(np.float64)


def test_the_dataset_holds_state_command_and_target_as_promised(tmp_path, source):
    summary = retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET))
    report = summary.report
    assert report == json.loads((tmp_path / "set" / module.REPORT_FILE).read_text())
    assert (report["recordings"], report["kept"] + report["changed"]) == (9, 9)
    assert "9 recordings" in str(summary)
    assert report["fk"]["p999_mm"] < 0.5
    assert report["fk"]["p999_deg"] < 0.2
    assert report["max_step_rad"] <= 0.1
    frames = _frames(tmp_path / "set")
    assert len(frames) == report["frames"]
    state, action = _column(frames, "observation.state"), _column(frames, "action")
    for _, episode in frames.groupby("episode_index"):
        # Without lag the arm is, a frame later, where it was sent.
        np.testing.assert_array_equal(state[episode.index[1:]], action[episode.index[:-1]])
    pose, target = _column(frames, "observation.ee_pose"), _column(frames, "observation.ee_target")
    np.testing.assert_allclose(np.abs((forward(ARM, state) * pose)[:, 3:].sum(axis=1)), 1.0, atol=1e-5)
    assert np.linalg.norm(forward(ARM, state)[:, :3] - pose[:, :3], axis=1).max() < 1e-6
    assert np.linalg.norm(forward(ARM, action)[:, :3] - target[:, :3], axis=1).max() < 0.5e-3
    assert (target[:, 6] >= 0).all()
    assert not list(tmp_path.glob("*.parts"))


def test_workers_and_interruptions_change_nothing(tmp_path, source, small_batches, monkeypatch):
    retarget_dataset(source, tmp_path / "alone", ARM, job=JobOptions(**QUIET))
    retarget_dataset(source, tmp_path / "two", ARM, job=JobOptions(progress=False, workers=2))

    calls = []
    save = module.save_outcomes

    def interrupted(path, outcomes):
        calls.append(path)
        if len(calls) == 3:
            raise KeyboardInterrupt
        save(path, outcomes)

    monkeypatch.setattr(module, "save_outcomes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        retarget_dataset(source, tmp_path / "resumed", ARM, job=JobOptions(**QUIET))
    retarget_dataset(source, tmp_path / "resumed", ARM, job=JobOptions(**QUIET, resume=True))
    assert len(calls) == 3 + 3  # two of five parts were done before
    for other in ("two", "resumed"):
        pd.testing.assert_frame_equal(
            _frames(tmp_path / "alone"), _frames(tmp_path / other), check_exact=True
        )


def test_resuming_a_finished_run_does_nothing(tmp_path, source):
    first = retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET, limit=2))
    again = retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET, limit=2, resume=True))
    assert again.report == first.report
    with pytest.raises(FileExistsError, match="exists already"):
        retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET, limit=3, resume=True))


def test_resuming_with_other_settings_is_refused(tmp_path, source, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(module, "write_dataset", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET, limit=2))
    with pytest.raises(ValueError, match=r"other settings \(options\)"):
        retarget_dataset(
            source,
            tmp_path / "set",
            ARM,
            module.RetargetOptions(seed=1),
            job=JobOptions(**QUIET, limit=2, resume=True),
        )


def test_a_test_split_has_sessions_of_its_own(tmp_path, source):
    summary = retarget_dataset(source, tmp_path / "sets", ARM, job=JobOptions(**QUIET, test_share=0.3))
    sessions = {
        split: set(pd.read_parquet(root / "meta/episodes/chunk-000/file-000.parquet")["session"])
        for split, root in summary.roots.items()
    }
    assert sessions.keys() == {"train", "test"}
    assert not sessions["train"] & sessions["test"]
    assert sessions["train"] | sessions["test"] == {f"session=s{i}" for i in range(3)}
    assert sessions["test"] == set(summary.report["test_sessions"])


def test_an_existing_dataset_is_kept(tmp_path, source):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "mine.txt").write_text("keep me")
    with pytest.raises(FileExistsError, match="exists already"):
        retarget_dataset(source, tmp_path / "set", ARM, job=JobOptions(**QUIET))


def test_nothing_usable_is_an_error_that_says_why(tmp_path):
    hand_table(2, seconds=0.2).to_parquet(tmp_path / "short.parquet")
    with pytest.raises(ValueError, match=r"none of the 2 recordings .*too short"):
        retarget_dataset(tmp_path / "short.parquet", tmp_path / "set", ARM, job=JobOptions(**QUIET))
    assert [path.name for path in tmp_path.iterdir()] == ["short.parquet"]


def test_an_arm_with_lag_follows_its_command():
    q = np.concatenate([np.zeros((1, 2)), np.ones((40, 2))])
    measured = follow_command(q, lag_s=0.1, fps=20)
    np.testing.assert_allclose(measured[1:4, 0], 1 - np.exp(-0.5 * np.arange(1, 4)))
    assert measured[-1, 0] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_array_equal(follow_command(q, 0.0, 20), q)


@pytest.mark.parametrize(
    ("values", "message"),
    [({"workers": -1}, "workers"), ({"test_share": 1.0}, "test_share"), ({"lag_s": -0.1}, "lag_s")],
)
def test_impossible_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        JobOptions(**values)
