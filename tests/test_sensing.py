"""What a recording adds: lag, encoder steps, noise and label errors, each by its definition."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.teleoperation.sensing import follow, lag_remainder, perturb_poses, quantise, wander

COMMANDS = np.random.default_rng(0).normal(size=(30, 3)).cumsum(axis=0)


def test_without_lag_the_next_position_is_the_command():
    positions = follow(COMMANDS, 0.0, 20)
    np.testing.assert_allclose(positions[1:], COMMANDS[:-1], atol=1e-12)
    np.testing.assert_allclose(positions[0], COMMANDS[0], atol=1e-12)


@pytest.mark.parametrize("lag_s", [0.01, 0.04, 0.2])
def test_with_lag_a_fixed_share_of_the_way_is_left_after_each_frame(lag_s):
    positions = follow(COMMANDS, lag_s, 20)
    left = positions[1:] - COMMANDS[:-1]
    np.testing.assert_allclose(left, np.exp(-0.05 / lag_s) * (positions[:-1] - COMMANDS[:-1]), atol=1e-12)


def test_a_steady_motion_is_followed_at_the_distance_that_the_lag_gives():
    ramp = 0.02 * np.arange(200.0)[:, None]
    behind = ramp[-1] - follow(ramp, 0.04, 20)[-1]
    np.testing.assert_allclose(behind, 0.02 / (1 - lag_remainder(0.04, 20)), rtol=1e-6)


def test_a_negative_lag_is_refused():
    with pytest.raises(ValueError, match="lag_s"):
        follow(COMMANDS, -0.1, 20)


def test_quantised_values_lie_on_the_grid_within_half_a_step():
    quantum = 25 / 65535
    values = quantise(COMMANDS, quantum)
    np.testing.assert_allclose(values / quantum, np.round(values / quantum), atol=1e-9)
    assert np.abs(values - COMMANDS).max() <= quantum / 2 + 1e-12
    assert quantise(COMMANDS, 0.0) is COMMANDS


def test_wander_has_its_standard_deviation_and_its_correlation_time():
    noise = wander((20000, 2), 0.3, 1.0, 20, np.random.default_rng(1))
    np.testing.assert_allclose(noise.std(axis=0), 0.3, rtol=0.15)
    correlation = (noise[20:] * noise[:-20]).mean(axis=0) / noise.var(axis=0)
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.1)


def test_perturbed_poses_are_off_by_the_offset_and_the_noise():
    rng = np.random.default_rng(2)
    quaternions = Rotation.random(5000, random_state=3).as_quat(canonical=True)
    poses = np.column_stack([rng.normal(size=(5000, 3)), quaternions])
    offset = np.array([1e-3, -2e-3, 0.0, 0.01, 0.0, -0.02])
    labels = perturb_poses(poses, offset, 1e-4, 3e-4, rng)
    turned = (Rotation.from_quat(labels[:, 3:]) * Rotation.from_quat(quaternions).inv()).as_rotvec()
    error = np.column_stack([labels[:, :3] - poses[:, :3], turned])
    np.testing.assert_allclose(error.mean(axis=0), offset, atol=5e-5)
    np.testing.assert_allclose(error.std(axis=0), np.repeat([1e-4, 3e-4], 3), rtol=0.1)
    assert np.all(labels[:, 6] >= 0)
    np.testing.assert_allclose(np.linalg.norm(labels[:, 3:], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(perturb_poses(poses, np.zeros(6), 0.0, 0.0, rng), poses, atol=1e-12)
