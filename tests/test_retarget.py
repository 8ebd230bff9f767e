"""Retargeting of recordings to joint trajectories."""

import numpy as np
import pytest
from hand_recordings import hand_motion, hand_recording
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.retargeting.recordings import Recording
from lerobot_mimicik.data.retargeting.retarget import CHANGED, DROPPED, KEPT, Retargeter, RetargetOptions
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.trajectory_ik import forward, joint_range

ARM = describe_arm("airbot_play")


@pytest.fixture(scope="module")
def retargeter():
    return Retargeter(ARM)


@pytest.fixture(scope="module")
def outcomes(retargeter):
    recordings = [hand_recording(seed, size=0.6) for seed in range(6)]
    return recordings, retargeter.retarget(recordings)


def test_joints_follow_the_poses_within_the_limits(retargeter, outcomes):
    lower, upper = joint_range(ARM)
    for outcome in outcomes[1]:
        assert outcome.status == CHANGED
        pose = forward(ARM, outcome.q)
        assert np.linalg.norm(pose[:, :3] - outcome.target[:, :3], axis=1).max() <= 0.4e-3
        turned = Rotation.from_quat(pose[:, 3:]) * Rotation.from_quat(outcome.target[:, 3:]).inv()
        assert turned.magnitude().max() <= 2.5e-3
        assert ((outcome.q >= lower) & (outcome.q <= upper)).all()
        assert np.abs(np.diff(outcome.q, axis=0)).max() <= 0.1
        assert retargeter.collision.clearance(outcome.q).min() >= retargeter.options.clearance


def test_what_was_changed_is_stated(outcomes):
    for recording, outcome in zip(*outcomes, strict=True):
        assert (outcome.name, outcome.session) == (recording.name, recording.session)
        scale = outcome.changes.get("translation scaled", 1.0)
        path = np.linalg.norm(np.diff(recording.pose[:, :3], axis=0), axis=1).sum()
        placed = np.linalg.norm(np.diff(outcome.target[:, :3], axis=0), axis=1).sum()
        assert placed == pytest.approx(scale * path, rel=0.03)
        slowed = outcome.changes.get("slowed down", 1.0)
        assert (len(outcome.q) - 1) == pytest.approx(slowed * (len(recording) - 1), abs=1)


def test_a_small_slow_motion_is_kept_as_it_is(retargeter):
    recording = hand_recording(0, size=0.05, seconds=1.0)
    outcome = retargeter.retarget([recording])[0]
    assert (outcome.status, outcome.changes) == (KEPT, {})
    # Placed elsewhere as a whole, with the distances of every frame from the first as they were.
    before, after = (
        np.linalg.norm(pose[:, :3] - pose[0, :3], axis=1) for pose in (recording.pose, outcome.target)
    )
    np.testing.assert_allclose(after, before, atol=1e-3)


def test_a_recording_fares_alike_whatever_its_batch(retargeter, outcomes):
    recordings, together = outcomes
    alone = retargeter.retarget(recordings[4:5], first_index=4)[0]
    assert alone.changes == together[4].changes
    np.testing.assert_allclose(alone.target, together[4].target, atol=1e-3)


def test_the_seed_changes_the_placement(outcomes):
    recordings, before = outcomes
    after = Retargeter(ARM, RetargetOptions(seed=1)).retarget(recordings[:1])[0]
    assert after.target[0, :3] != pytest.approx(before[0].target[0, :3], abs=1e-4)


def test_a_hopeless_recording_is_dropped_with_its_reason(retargeter):
    t, pose = hand_motion(0)
    outcomes = retargeter.retarget([Recording("short", "s", t[:3], pose[:3]), hand_recording(1)])
    assert (outcomes[0].name, outcomes[0].status, outcomes[0].reason) == ("short", DROPPED, "too short")
    assert outcomes[1].status != DROPPED


def test_placements_that_all_collide_are_given_as_the_reason():
    options = RetargetOptions(clearance=1.0, attempts=1)
    outcome = Retargeter(ARM, options).retarget([hand_recording(0, size=0.1)])[0]
    assert (outcome.status, outcome.reason) == (DROPPED, "collision")


def test_the_gripper_keeps_pace_with_a_slowed_motion(retargeter):
    recording = hand_recording(1, size=0.8)
    recording.gripper = np.linspace(0.0, 0.07, len(recording))
    outcome = retargeter.retarget([recording])[0]
    assert outcome.gripper is not None
    assert outcome.gripper.shape == (len(outcome.q),)
    assert (np.diff(outcome.gripper) > 0).all()


@pytest.mark.parametrize("name", ["max_step", "max_position_error"])
def test_impossible_options_are_named(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        RetargetOptions(**{name: 0.0})
