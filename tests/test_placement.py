"""Placing recordings before an arm."""

import dataclasses

import numpy as np
import pytest
from hand_recordings import hand_motion
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.home import find_home
from lerobot_mimicik.data.retargeting.placement import (
    Motion,
    PlacementOptions,
    find_workspace,
    propose,
)
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.trajectory_ik import forward, joint_range

ARM = describe_arm("airbot_play")
OPTIONS = PlacementOptions()


@pytest.fixture(scope="module")
def workspace():
    return find_workspace(ARM, OPTIONS, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_placed_motion_lies_in_the_box_and_moves_alike(workspace, seed):
    pose = hand_motion(seed, size=0.8)[1]
    motion = Motion.of(pose)
    placement = propose(motion, workspace, OPTIONS, 1.0, np.random.default_rng(seed))
    placed = placement.apply(motion)
    assert (np.abs(placed[:, :3] - workspace.centre) <= workspace.size / 2 + 1e-9).all()
    np.testing.assert_allclose(np.linalg.norm(placed[:, 3:], axis=1), 1.0)
    # The path is scaled, and turned about the vertical.
    steps, placed_steps = np.diff(pose[:, :3], axis=0), np.diff(placed[:, :3], axis=0)
    np.testing.assert_allclose(
        np.linalg.norm(placed_steps, axis=1), placement.scale * np.linalg.norm(steps, axis=1)
    )
    np.testing.assert_allclose(placed_steps[:, 2], placement.scale * steps[:, 2], atol=1e-12)


def test_rotations_are_those_of_the_hand_when_nothing_is_scaled(workspace):
    pose = hand_motion(0)[1]
    motion = Motion.of(pose)
    options = PlacementOptions(max_rotation=3.0)
    placement = propose(motion, workspace, options, 1.0, np.random.default_rng(0))
    placed = placement.apply(motion)
    turn = Rotation.from_matrix(placement.turn)
    recorded, found = Rotation.from_quat(pose[:, 3:]), Rotation.from_quat(placed[:, 3:])
    expected = turn * (recorded[1:] * recorded[:-1].inv()) * turn.inv()
    assert ((found[1:] * found[:-1].inv()) * expected.inv()).magnitude().max() < 1e-9


def test_the_mean_orientation_stays_near_home(workspace):
    motion = Motion.of(hand_motion(1)[1])
    home = Rotation.from_quat(workspace.quaternion_home)
    rng = np.random.default_rng(0)
    for _ in range(20):
        centre = Rotation.from_quat(propose(motion, workspace, OPTIONS, 1.0, rng).centre_quaternion)
        assert (centre * home.inv()).magnitude() <= OPTIONS.max_tilt + 1e-9


def test_chosen_frames_are_those_of_the_whole(workspace):
    motion = Motion.of(hand_motion(2)[1])
    placement = propose(motion, workspace, OPTIONS, 0.5, np.random.default_rng(0))
    rows = np.array([0, 7, 20])
    np.testing.assert_allclose(placement.apply(motion, rows), placement.apply(motion)[rows])


def test_shrinking_makes_the_motion_smaller(workspace):
    motion = Motion.of(hand_motion(3)[1])
    large, small = (propose(motion, workspace, OPTIONS, s, np.random.default_rng(0)) for s in (1.0, 0.5))
    assert small.scale == pytest.approx(0.5 * large.scale)
    assert small.rotation_scale == pytest.approx(0.5 * large.rotation_scale)


def test_the_workspace_is_the_papers_and_above_the_floor(workspace):
    np.testing.assert_allclose(workspace.size, [0.43, 0.40, 0.23], atol=0.01)
    assert workspace.centre[2] - workspace.size[2] / 2 > 0


def test_a_workspace_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="does not reach"):
        find_workspace(ARM, PlacementOptions(centre=(2.0, 0.0, 0.3)), 0.0)


def test_an_arm_without_a_home_gets_a_usable_one():
    bare = dataclasses.replace(ARM, home=())
    home = find_home(bare, 0.0)
    lower, upper = joint_range(bare, 0.1)
    assert ((home > lower) & (home < upper)).all()
    assert forward(bare, home[None])[0, 2] > 0.1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"workspace": (0.1, 0.2)}, "workspace must be three lengths"),
        ({"workspace": (0.1, 0.2, 0.0)}, "positive along every axis"),
        ({"max_tilt": -0.1}, "max_tilt not negative"),
    ],
)
def test_impossible_options_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        PlacementOptions(**values)
