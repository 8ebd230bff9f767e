"""Tracking a hand: close where the arm can, smooth and within limits where it cannot."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.teleoperation.hand_tracking import (
    damped_step,
    limit_norm,
    limit_speed,
    smooth,
    solve_poses,
    track,
    twist_between,
)
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm


@pytest.fixture(scope="module", params=[name for name in SHIPPED_ARMS if not name.startswith("so10")])
def arm(request):
    return ArmArrays(describe_arm(request.param))


def _moved(pose, translation, rotation):
    out = pose.copy()
    out[:3, 3] += translation
    out[:3, :3] = Rotation.from_rotvec(rotation).as_matrix() @ pose[:3, :3]
    return out


def test_the_twist_between_poses_is_the_displacement(arm):
    pose = arm.matrix(arm.home[None])[0]
    moved = _moved(pose, [0.01, -0.02, 0.03], [0.02, 0.01, -0.03])
    expected = [0.01, -0.02, 0.03, 0.02, 0.01, -0.03]
    np.testing.assert_allclose(twist_between(pose[None], moved[None])[0], expected, atol=2e-5)


def test_a_reachable_hand_path_is_tracked_to_millimetres(arm):
    # A slow circle about the home pose, at 0.1 m/s, with a little turning.
    home = arm.matrix(arm.home[None])[0]
    angle = np.linspace(0, 2 * np.pi, 80)
    targets = np.array(
        [_moved(home, [0.04 * np.sin(a), 0.04 * (1 - np.cos(a)), 0], [0, 0, 0.1 * np.sin(a)]) for a in angle]
    )
    motion = track(arm, arm.home[None], targets[None], 0.2)[0]
    error = twist_between(arm.matrix(motion), targets)
    assert np.linalg.norm(error[:, :3], axis=1).max() < 4e-3
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.02


def test_an_unreachable_or_impossible_hand_path_stays_bounded(arm):
    rng = np.random.default_rng(0)
    home = arm.matrix(arm.home[None])[0]
    jumps = [_moved(home, rng.normal(size=3), rng.normal(size=3)) for _ in range(30)]
    targets = np.repeat(np.array(jumps), 10, axis=0)
    motion = track(arm, arm.home[None], targets[None], 0.08)[0]
    assert np.all((motion >= arm.lower) & (motion <= arm.upper))
    assert np.abs(np.diff(motion, axis=0)).max() <= 0.08 + 1e-12


def test_episodes_of_a_batch_do_not_influence_each_other(arm):
    home = arm.matrix(arm.home[None])[0]
    targets = np.array([[_moved(home, [0, 0.001 * t * k, 0], [0, 0, 0]) for t in range(20)] for k in (1, -2)])
    together = track(arm, np.tile(arm.home, (2, 1)), targets, 0.1)
    alone = track(arm, arm.home[None], targets[1:], 0.1)
    np.testing.assert_allclose(together[1:], alone, atol=1e-12)


def test_solved_poses_are_reached_and_failures_are_told(arm):
    home = arm.matrix(arm.home[None])[0]
    targets = np.array(
        [_moved(home, [0.03, 0.02, -0.02], [0.1, 0.1, 0]), _moved(home, [5.0, 0, 0], [0, 0, 0])]
    )
    q, errors = solve_poses(arm, np.tile(arm.home, (2, 1)), targets)
    assert np.all(errors[0] < [1e-4, 1e-3])
    assert errors[1, 0] > 1.0
    np.testing.assert_allclose(arm.matrix(q)[0], targets[0], atol=1e-3)


def test_a_damped_step_is_bounded_at_a_singularity_and_exact_elsewhere(arm):
    twist = np.array([[1e-3, -1e-3, 5e-4, 2e-3, 1e-3, 0.0]])
    home = arm.jacobian(arm.home[None])
    step = damped_step(home, twist, 1e-6)
    np.testing.assert_allclose((home[0] @ step[0]), twist[0], atol=1e-6)
    singular = np.zeros_like(home)
    assert np.array_equal(damped_step(singular, twist), np.zeros_like(step))


def test_limiting_keeps_direction():
    step = np.array([[0.3, -0.1, 0.0], [0.01, 0.02, 0.0]])
    limited = limit_norm(step, 0.1)
    np.testing.assert_allclose(limited, [[0.1, -0.1 / 3, 0.0], [0.01, 0.02, 0.0]])


def test_slowing_bounds_the_speed_and_keeps_the_path():
    time = np.linspace(0, 1, 60)[:, None]
    path = np.column_stack([np.tanh(8 * (time - 0.5)), 0.5 * np.tanh(8 * (time - 0.5))])
    slowed = limit_speed(path, 0.05)
    assert np.abs(np.diff(slowed, axis=0)).max() <= 0.05
    assert len(slowed) > len(path)
    np.testing.assert_allclose(slowed[:, 1], 0.5 * slowed[:, 0], atol=1e-9)
    np.testing.assert_allclose(slowed[[0, -1]], path[[0, -1]], atol=1e-6)
    assert limit_speed(path, 10.0) is path


def test_smoothing_keeps_a_constant_and_takes_out_shaking():
    shaking = np.where(np.arange(100) % 2 == 0, 1.0, -1.0)[:, None]
    assert np.abs(smooth(shaking, 2.0)[10:-10]).max() < 1e-3
    np.testing.assert_allclose(smooth(np.ones((10, 2)), 2.0), 1.0)
