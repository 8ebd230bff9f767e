"""Synthetic teleoperation: reproducible, bounded, split by session, and true to the recording facts."""

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.teleoperation.sensing import ENCODER_QUANTUM_RAD, lag_remainder
from lerobot_mimicik.data.teleoperation.session import OOD_TASK, RECOVERY_TASK
from lerobot_mimicik.data.teleoperation.singularities import KINDS, SingularityGauge
from lerobot_mimicik.data.teleoperation.synthetic import SyntheticConfig, make_synthetic, plan_sessions
from lerobot_mimicik.data.writer import read_arm_json
from lerobot_mimicik.kinematics.arms import describe_arm

# Short, but with everything in it: three sessions, one of them for testing, recoveries and all singularities.
CONFIG = SyntheticConfig(
    episode_s=8.0, episodes_per_session=4, recovery_share=0.3, ood_episodes=1, ood_s=60.0
)
COLUMNS = ("observation.state", "observation.ee_pose", "observation.ee_target", "action")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic")
    summary = make_synthetic(
        folder,
        12,
        describe_arm("airbot_play"),
        seed=3,
        workers=1,
        test_share=0.3,
        config=CONFIG,
        progress=False,
    )
    return folder, summary


@pytest.fixture(scope="module")
def arm():
    return ArmArrays(describe_arm("airbot_play"))


def _open(folder, split):
    return LeRobotDataset(f"local/{split}", root=folder / split)


def _columns(dataset):
    table = dataset.hf_dataset.with_format("numpy")
    return {key: np.asarray(table[key][:], dtype=np.float64) for key in (*COLUMNS, "episode_index")}


def _episodes(dataset):
    columns = _columns(dataset)
    for episode in np.unique(columns["episode_index"]):
        rows = columns["episode_index"] == episode
        yield {key: columns[key][rows] for key in COLUMNS}


def _error(poses, labels):
    """Distances (n,) [m] and angles (n,) [rad] between poses (n, 7)."""
    turned = Rotation.from_quat(labels[:, 3:]) * Rotation.from_quat(poses[:, 3:]).inv()
    return np.linalg.norm(labels[:, :3] - poses[:, :3], axis=1), turned.magnitude()


@pytest.mark.parametrize("split", ["train", "test", "ood"])
def test_lerobot_opens_each_split_with_tasks_and_arm(made, split):
    folder, summary = made
    dataset = _open(folder, split)
    assert (dataset.num_episodes, dataset.num_frames) == (summary.episodes[split], summary.frames[split])
    assert dataset.fps == 20
    item = dataset[0]
    assert {key: tuple(item[key].shape) for key in COLUMNS} == {
        "observation.state": (6,), "observation.ee_pose": (7,), "observation.ee_target": (7,), "action": (6,),
    }  # fmt: skip
    assert item["task"]
    assert read_arm_json(folder / split) == describe_arm("airbot_play")


def test_splits_share_no_session_and_hold_all_episodes(made):
    folder, summary = made
    sessions = {split: set(_open(folder, split).meta.episodes["session"]) for split in summary.roots}
    assert {split: len(names) for split, names in sessions.items()} == {"train": 2, "test": 1, "ood": 1}
    assert len(set.union(*sessions.values())) == 4
    assert summary.episodes["train"] + summary.episodes["test"] == 12
    assert str(summary).count("sessions") == 3


def test_recovery_episodes_are_as_many_as_asked(made):
    folder, summary = made
    tasks = [task for split in ("train", "test") for task in _open(folder, split).meta.episodes["tasks"]]
    recoveries = sum(names == [RECOVERY_TASK] for names in tasks)
    assert recoveries == summary.recovery
    assert recoveries == pytest.approx(0.3 * 12, abs=1.0)
    assert all(names == [OOD_TASK] for names in _open(folder, "ood").meta.episodes["tasks"])


@pytest.mark.parametrize("split", ["train", "test", "ood"])
def test_commands_are_bounded_in_speed_limits_and_collisions(made, arm, split):
    for episode in _episodes(_open(made[0], split)):
        action, state = episode["action"], episode["observation.state"]
        assert np.abs(np.diff(action, axis=0)).max() < 0.1
        assert np.abs(action - state).max() < 0.1
        for joints in (action, state):
            assert np.all((joints >= arm.lower - 0.01) & (joints <= arm.upper + 0.01))
            assert np.isfinite(joints).all()
        # Tremor comes after the check: it may take up a few millimetres of clearance.
        assert arm.free(action).mean() > 0.99


@pytest.mark.parametrize("split", ["train", "ood"])
def test_joints_lie_on_the_encoder_grid(made, split):
    columns = _columns(_open(made[0], split))
    for key in ("observation.state", "action"):
        steps = columns[key] / ENCODER_QUANTUM_RAD
        np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)


def test_the_state_follows_the_command_by_the_lag(made):
    share = lag_remainder(CONFIG.lag_s, 20)
    for episode in _episodes(_open(made[0], "train")):
        action, state = episode["action"], episode["observation.state"]
        expected = action[:-1] + share * (state[:-1] - action[:-1])
        # What is left are encoder steps, noise and the slow wander of friction.
        residual = state[1:] - expected
        assert residual.std() < 5e-4
        assert np.abs(residual).max() < 3e-3
        np.testing.assert_allclose(state[0], action[0], atol=2e-3)


def test_poses_are_those_of_the_joints_up_to_small_label_errors(made, arm):
    for split in ("train", "test", "ood"):
        for episode in _episodes(_open(made[0], split)):
            current = _error(arm.pose(episode["observation.state"]), episode["observation.ee_pose"])
            target = _error(arm.pose(episode["action"]), episode["observation.ee_target"])
            assert current[0].max() < 2e-3
            assert current[1].max() < 6e-3
            assert np.median(target[0]) < 1e-3
            assert target[0].max() < CONFIG.stray_m + 2e-3
            assert np.all(episode["observation.ee_target"][:, 6] >= 0)


def test_hands_move_as_people_do(made):
    for split, (slow, fast) in {"train": (3e-3, 1e-2), "ood": (3e-3, 1.5e-2)}.items():
        columns = _columns(_open(made[0], split))
        distance = np.linalg.norm(
            columns["observation.ee_target"][:, :3] - columns["observation.ee_pose"][:, :3], axis=1
        )
        assert slow < distance.mean() < fast
    lengths = _open(made[0], "train").meta.episodes["length"]
    assert 0.5 * CONFIG.episode_s < np.mean(lengths) / 20 < 2 * CONFIG.episode_s


def test_the_near_singular_set_crosses_every_kind_of_singularity(made, arm):
    gauge = SingularityGauge.for_arm(arm, np.random.default_rng(0))
    dataset = _open(made[0], "ood")
    assert dataset.num_frames == round(CONFIG.ood_s * 20)
    for episode in _episodes(dataset):
        measures = gauge(episode["observation.state"])
        assert set(measures) == set(KINDS)
        for measure in measures.values():
            assert measure.min() < 0.03
        near = gauge.nearest(episode["observation.state"]) < 0.1
        assert 0.1 < near.mean() < 0.9


def test_the_same_seed_gives_the_same_data_on_any_number_of_workers(made, tmp_path):
    folder, _ = made
    arguments = {"test_share": 0.3, "ood": False, "config": CONFIG, "progress": False}
    make_synthetic(tmp_path / "two", 12, describe_arm("airbot_play"), seed=3, workers=2, **arguments)
    for split in ("train", "test"):
        again, first = _columns(_open(tmp_path / "two", split)), _columns(_open(folder, split))
        for key in COLUMNS:
            np.testing.assert_array_equal(again[key], first[key])


def test_another_seed_gives_other_data(made, tmp_path):
    make_synthetic(
        tmp_path / "other", 2, describe_arm("piper"), seed=4, workers=1, test_share=0.0, ood=False,
        config=CONFIG, progress=False,
    )  # fmt: skip
    other = _columns(_open(tmp_path / "other", "train"))["action"]
    assert not np.array_equal(other[:50], _columns(_open(made[0], "train"))["action"][:50])
    assert not (tmp_path / "other" / "test").exists()


def test_what_exists_is_not_overwritten_unasked(made):
    with pytest.raises(FileExistsError, match="train"):
        make_synthetic(made[0], 4, describe_arm("airbot_play"), config=CONFIG, progress=False)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"episodes": 1}, "episodes"), ({"test_share": 1.0}, "test_share"), ({"workers": 0}, "workers")],
)
def test_impossible_requests_are_refused_by_name(tmp_path, arguments, name):
    episodes = arguments.pop("episodes", 4)
    with pytest.raises(ValueError, match=name):
        make_synthetic(tmp_path / "none", episodes, describe_arm("airbot_play"), progress=False, **arguments)


@pytest.mark.parametrize(
    "options", [{"lag_s": -0.1}, {"fps": 0}, {"recovery_share": 1.5}, {"max_step": 0.0}, {"stray_m": -1e-3}]
)
def test_impossible_configurations_are_refused_by_name(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        SyntheticConfig(**options)


def test_a_plan_deals_out_every_episode_and_recovery_in_proportion():
    plans = plan_sessions(400, KINDS, 0, 0.15, SyntheticConfig())
    everyone = plans["train"] + plans["test"]
    assert sum(plan.regular + len(plan.recovery) for plan in everyone) == 400
    assert len({plan.name for plan in everyone}) == len(everyone) == 20
    assert len({plan.seed for plan in everyone}) == 20
    assert len(plans["test"]) == 3
    recoveries = [kind for plan in everyone for kind in plan.recovery]
    assert len(recoveries) == 25
    assert {recoveries.count(kind) for kind in KINDS} <= {7, 8, 9}
