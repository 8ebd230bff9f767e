"""Cleaning and resampling of raw recordings."""

import numpy as np
import pytest
from hand_recordings import hand_motion, hand_recording
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_mimicik.data.retargeting.cleaning import (
    CleaningOptions,
    UnusableRecording,
    clean_recording,
    continuous_signs,
    local_quadratic,
)
from lerobot_mimicik.data.retargeting.recordings import Recording


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arccos(np.minimum(1.0, np.abs((a * b).sum(axis=1))))


def _assert_same_motion(pose: np.ndarray, expected: np.ndarray) -> None:
    assert np.linalg.norm(pose[:, :3] - expected[:, :3], axis=1).max() < 0.005
    assert _angle(pose[:, 3:], expected[:, 3:]).max() < 0.03


def test_a_clean_recording_keeps_its_motion():
    recording = hand_recording(0)
    clean = clean_recording(recording)
    assert clean.repairs == {}
    _assert_same_motion(clean.pose, recording.pose)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), rate=st.sampled_from([15.0, 60.0, 200.0]))
def test_uneven_stamps_give_an_even_clock(seed, rate):
    rng = np.random.default_rng(seed)
    t, pose = hand_motion(seed, rate=400)
    rows = np.unique(
        np.round(np.arange(0, len(t) - 1, 400 / rate) + rng.uniform(-0.3, 0.3) * 400 / rate).astype(int)
    )
    rows = rows[rows >= 0]
    clean = clean_recording(Recording("a", "b", t[rows], pose[rows]))
    grid = t[rows[0]] + np.arange(len(clean.pose)) / 20
    expected = pose[np.round(grid * 400).astype(int)]
    assert len(clean.pose) == int((t[rows[-1]] - t[rows[0]]) * 20 + 1e-6) + 1
    _assert_same_motion(clean.pose, expected)


def test_faults_are_mended_and_counted():
    recording = hand_recording(1, seconds=4.0)
    t, pose = recording.t.copy(), recording.pose.copy()
    pose[10, 2] = np.nan
    pose[20, :3] += 3.0
    pose[21, :3] += 3.0
    pose[30, 3:] = 0.0
    pose[40:, 3:] *= -1
    t[50] = t[49]
    clean = clean_recording(Recording("a", "b", t, pose))
    assert clean.repairs == {
        "rows not finite": 1,
        "rows without a unit quaternion": 1,
        "rows with a repeated stamp": 1,
        "rows cut at jumps or gaps": 2,
    }
    _assert_same_motion(clean.pose, recording.pose)
    assert ((clean.pose[1:, 3:] * clean.pose[:-1, 3:]).sum(axis=1) > 0).all()


def test_a_jump_to_another_place_cuts_the_recording():
    recording = hand_recording(2, seconds=4.0)
    recording.pose[60:, :3] += 2.0
    clean = clean_recording(recording)
    assert len(clean.pose) == 60
    assert clean.repairs == {"rows cut at jumps or gaps": 20}


def test_a_hole_in_time_cuts_the_recording():
    recording = hand_recording(3, seconds=4.0)
    recording.t[30:] += 1.5
    assert len(clean_recording(recording).pose) == 50
    assert len(clean_recording(recording, CleaningOptions(max_gap=2.0)).pose) == 80 + 30


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda r: r.pose.__setitem__((slice(0, 20), 0), np.inf), "too many rows not finite"),
        (
            lambda r: r.pose.__setitem__((slice(0, 20), slice(3, 7)), 0.0),
            "too many rows without a unit quaternion",
        ),
        (
            lambda r: r.t.__setitem__(slice(None), r.t[::-1].copy()),
            "too many rows whose stamp runs backwards",
        ),
        (lambda r: r.t.__setitem__(slice(None), 1.0), "too many rows with a repeated stamp"),
        (lambda r: r.t.__imul__(0.1), "too short"),
    ],
)
def test_what_cannot_be_mended_is_named(spoil, reason):
    recording = hand_recording(4)
    spoil(recording)
    with pytest.raises(UnusableRecording) as caught:
        clean_recording(recording)
    assert caught.value.reason == reason


def test_an_empty_recording_is_named():
    with pytest.raises(UnusableRecording, match="empty"):
        clean_recording(Recording("a", "b", np.empty(0), np.empty((0, 7))))


def test_the_gripper_comes_along():
    recording = hand_recording(5)
    recording.gripper = np.linspace(0.0, 0.07, len(recording))
    clean = clean_recording(recording)
    assert clean.gripper is not None
    np.testing.assert_allclose(clean.gripper, recording.gripper, atol=1e-6)


def test_local_quadratic_reproduces_parabolas():
    t = np.sort(np.random.default_rng(0).uniform(0, 2, 60))
    grid = np.linspace(0.1, 1.9, 30)
    found = local_quadratic(t, np.stack([t**2, 3 - t], axis=1), grid, 0.05)
    np.testing.assert_allclose(found, np.stack([grid**2, 3 - grid], axis=1), atol=1e-3)


def test_continuous_signs_change_no_rotation():
    q = np.random.default_rng(0).normal(size=(50, 4))
    fixed = continuous_signs(q)
    np.testing.assert_allclose(np.abs(fixed), np.abs(q))
    assert ((fixed[1:] * fixed[:-1]).sum(axis=1) >= 0).all()


def test_impossible_options_are_named():
    with pytest.raises(ValueError, match="max_speed must be positive, got 0"):
        CleaningOptions(max_speed=0)
