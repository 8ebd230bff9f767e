"""Units and orders that numbers give away."""

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.plausibility import (
    COMMANDS_OUTSIDE_LIMITS,
    check_plausible,
    joint_limits,
    upper_reach,
    why_not_joints,
    why_not_order,
    why_not_poses,
)

ARMS = [describe_arm("airbot_play"), describe_arm("piper")]
WXYZ = [0, 1, 2, 6, 3, 4, 5]


def random_joints(arm, count=200, seed=0):
    lower, upper = joint_limits(arm)
    return np.random.default_rng(seed).uniform(lower, upper, (count, len(lower)))


@pytest.mark.parametrize("arm", ARMS)
def test_joints_and_poses_of_the_arm_itself_pass(arm):
    q = random_joints(arm)
    poses = array_chain(arm).pose(q)
    assert why_not_joints(arm, q) is None
    assert why_not_poses(arm, poses) is None
    assert why_not_order(arm, q, poses) is None
    assert (np.linalg.norm(poses[:, :3], axis=1) <= upper_reach(arm)).all()


def test_joints_a_little_outside_and_targets_out_of_reach_pass():
    arm = ARMS[0]
    lower, upper = joint_limits(arm)
    assert why_not_joints(arm, [lower - 0.3, upper + 0.3]) is None
    assert why_not_poses(arm, [2.0, 0.0, 0.0, 0, 0, 0, 1]) is None


@pytest.mark.parametrize("arm", ARMS)
def test_degrees_are_refused_by_name(arm):
    q = random_joints(arm)
    with pytest.raises(
        ValueError, match=r"joint\d is .* rad in frame \d+.*as degrees the numbers would fit.*units=deg"
    ):
        check_plausible(arm, np.degrees(q), joints_remedy="--policy.joint_units=deg")
    assert "degrees" in why_not_joints(arm, np.degrees(q[0]))


def test_joints_of_no_unit_are_refused_without_a_guess():
    reason = why_not_joints(ARMS[0], [0, 0, 0, 0, 0, 4096.0])
    assert "joint6 is 4096 rad" in reason
    assert "as degrees the numbers would fit" not in reason


def test_millimetres_are_refused():
    arm = ARMS[0]
    poses = array_chain(arm).pose(random_joints(arm))
    poses[:, :3] *= 1000
    with pytest.raises(ValueError, match=r"state: the position .* m in frame .*reach.*millimetres"):
        check_plausible(arm, poses=poses, what="state")
    assert why_not_poses(arm, [1e308, 0, 0]) is not None


@pytest.mark.parametrize("side", ["none", "tool", "base"])
def test_scalar_first_quaternions_are_refused_whatever_the_tool_or_base(side):
    from lerobot_mimicik.kinematics.poses import compose

    arm, other = ARMS[0], np.array([0.1, 0.0, 0.2, 0.5, 0.5, 0.5, 0.5])
    q = random_joints(arm)
    poses = array_chain(arm).pose(q)
    poses = {"none": poses, "tool": compose(poses, other), "base": compose(other, poses)}[side]
    assert why_not_order(arm, q, poses) is None
    assert "w x y z" in why_not_order(arm, q, poses[:, WXYZ])


def test_numbers_that_are_not_finite_are_not_judged_here():
    arm = ARMS[0]
    assert why_not_joints(arm, np.full((3, 6), np.nan)) is None
    assert why_not_poses(arm, np.full((3, 7), np.inf)) is None
    assert why_not_order(arm, np.full((3, 6), np.nan), np.zeros((3, 7))) is None
    assert why_not_joints(arm, np.empty((0, 6))) is None


def test_wrong_shapes_are_errors():
    with pytest.raises(ValueError, match="joints of shape"):
        why_not_joints(ARMS[0], np.zeros((3, 5)))
    with pytest.raises(ValueError, match="poses of shape"):
        why_not_order(ARMS[0], np.zeros((3, 6)), np.zeros((2, 7)))


def test_an_orientation_that_does_not_turn_is_judged_by_fk_alone():
    arm = ARMS[0]
    q = np.tile(np.add(arm.home, [0.0, 0.3, 0.1, 0.4, 0.2, 0.7]), (5, 1))
    poses = array_chain(arm).pose(q)
    assert why_not_order(arm, q, poses) is None
    assert "w x y z" in why_not_order(arm, q[0], poses[0, WXYZ])
    assert "w x y z" in why_not_order(arm, q, poses[:, WXYZ])


def test_commands_may_lie_further_outside_than_measurements():
    q = np.array([ARMS[0].home]) + 3.0
    assert why_not_joints(ARMS[0], q) is not None
    assert why_not_joints(ARMS[0], q, COMMANDS_OUTSIDE_LIMITS) is None
    assert why_not_joints(ARMS[0], np.degrees(q), COMMANDS_OUTSIDE_LIMITS) is not None
