"""Whole-trajectory inverse kinematics: accuracy, limits, smoothness."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.trajectory_ik import (
    TrajectoryOptions,
    forward,
    joint_range,
    pose_residual,
    solve_trajectories,
)

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


def _motion(seed: int, frames: int, size: float = 0.25) -> np.ndarray:
    """Joints (frames, 6) of a smooth motion about home, inside the limits."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / 20
    waves = sum(
        rng.normal(size=6) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6, 6)) for f in (0.2, 0.5, 0.9)
    )
    lower, upper = joint_range(ARM, 0.2)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    # A squashed motion keeps smooth where a clipped one has corners.
    start = np.arctanh((HOME - middle) / half)
    return middle + half * np.tanh(start + size * waves)


def test_reachable_motion_is_followed_and_found_again():
    q = [_motion(seed, frames) for seed, frames in enumerate((30, 1, 2, 65))]
    targets = [forward(ARM, joints) for joints in q]
    solutions = solve_trajectories(ARM, targets, np.stack([joints[0] for joints in q]) + 0.05)
    for joints, solution in zip(q, solutions, strict=True):
        assert solution.q.shape == joints.shape
        assert solution.position_error.max() < 1e-4
        assert solution.rotation_error.max() < 1e-3
        assert np.abs(solution.q - joints).max() < 0.02


def test_reported_errors_are_those_of_forward_kinematics():
    target = forward(ARM, _motion(1, 20)) + np.array([0.5, 0, 0, 0, 0, 0, 0])
    solution = solve_trajectories(ARM, [target], HOME[None])[0]
    pose = forward(ARM, solution.q)
    np.testing.assert_allclose(
        solution.position_error, np.linalg.norm(pose[:, :3] - target[:, :3], axis=1), atol=1e-12
    )
    assert solution.position_error.min() > 0.05


def test_joint_limits_hold_even_where_the_target_asks_for_more():
    options = TrajectoryOptions(limit_margin=0.1)
    lower, upper = joint_range(ARM, 0.1)
    q = np.linspace(HOME, [*(upper + 0.08)[:1], *HOME[1:]], 60)
    solution = solve_trajectories(ARM, [forward(ARM, q)], HOME[None], options)[0]
    assert (solution.q >= lower - 1e-12).all()
    assert (solution.q <= upper + 1e-12).all()


def test_a_solution_does_not_depend_on_its_companions():
    targets = [forward(ARM, _motion(seed, 25 + seed)) for seed in range(5)]
    starts = np.tile(HOME, (5, 1))
    together = solve_trajectories(ARM, targets, starts)
    alone = solve_trajectories(ARM, targets[3:4], starts[:1])[0]
    np.testing.assert_allclose(together[3].q, alone.q, atol=1e-5)


def test_a_wrist_singularity_is_passed_without_a_jump():
    """The hand passes 2 degrees beside the direction in which joints 4 and 6 are one."""
    q = np.tile([0.0, -1.2, 1.3, 1.57, 0.0, -1.57], (81, 1))
    q[:, 4] = np.linspace(-0.5, 0.5, 81)
    target = forward(ARM, q)
    beside = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(2.0)]) * Rotation.from_quat(target[:, 3:])
    target[:, 3:] = beside.as_quat()
    relaxed = solve_trajectories(ARM, [target], q[:1], TrajectoryOptions(smoothness=1e5, iterations=40))[0]
    assert np.abs(np.diff(relaxed.q, axis=0)).max() < 0.1
    assert relaxed.position_error.max() < 2e-3


def test_smoothness_gives_way_to_tracking_as_it_is_asked_to():
    rough = np.repeat(forward(ARM, HOME[None]), 60, axis=0)
    rough[:, :3] += np.random.default_rng(0).normal(size=(60, 3)) * 1e-3
    bends = []
    for smoothness in (1e3, 1e6):
        q = solve_trajectories(ARM, [rough], HOME[None], TrajectoryOptions(smoothness=smoothness))[0].q
        bends.append(np.abs(np.diff(q, n=2, axis=0)).mean())
    assert bends[1] < 0.5 * bends[0]


def test_residual_is_the_motion_to_the_target():
    rng = np.random.default_rng(0)
    rotation = Rotation.random(100, rng=rng)
    vector = rng.normal(size=(100, 3))
    vector *= (rng.uniform(1e-9, 3.1, size=100) / np.linalg.norm(vector, axis=1))[:, None]
    target = Rotation.from_rotvec(vector) * rotation
    found = pose_residual(rotation.as_matrix(), np.zeros((100, 3)), target.as_matrix(), np.ones((100, 3)))
    np.testing.assert_allclose(found[:, 3:], vector, atol=1e-7)
    np.testing.assert_allclose(found[:, :3], 1.0)


@pytest.mark.parametrize(
    ("targets", "q_start", "message"),
    [
        ([np.zeros((3, 6))], HOME[None], r"targets\[0\] must have shape \(T, 7\)"),
        ([np.zeros((0, 7))], HOME[None], "T > 0"),
        ([np.full((3, 7), np.nan)], HOME[None], "not finite"),
        ([np.zeros((3, 7))], HOME, r"q_start must have shape \(1, 6\)"),
    ],
)
def test_inputs_that_do_not_fit_are_named(targets, q_start, message):
    with pytest.raises(ValueError, match=message):
        solve_trajectories(ARM, targets, q_start)


def test_no_trajectories_give_no_solutions():
    assert solve_trajectories(ARM, [], np.empty((0, 6))) == []
