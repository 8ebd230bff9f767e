"""A recording that cannot be of the arm is refused, with column, episode, frame and remedy."""

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.plausibility import joint_limits, why_not_same_arm
from lerobot_mimicik.kinematics.recorded import Column, check_recorded

ARM = describe_arm("airbot_play")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
LOWER, UPPER = joint_limits(ARM)
JOINTS = np.random.default_rng(0).uniform(LOWER, UPPER, (40, 6))
EPISODES = np.repeat([3, 4], 20)


def check(joints=JOINTS, commands=JOINTS, current=None, target=None, **options):
    poses = array_chain(ARM).pose(JOINTS)
    check_recorded(
        ARM,
        EPISODES,
        Column("observation.state", joints, ARM.joint_names),
        Column("action", commands, ARM.joint_names),
        Column("observation.ee_pose", poses if current is None else current, POSE),
        Column("observation.ee_target", poses if target is None else target, POSE),
        **options,
    )


def test_a_recording_of_the_arm_passes():
    check()


@pytest.mark.parametrize("column", ["joints", "commands", "current", "target"])
def test_what_is_not_finite_is_named_with_its_place(column):
    values = (JOINTS if column in ("joints", "commands") else array_chain(ARM).pose(JOINTS)).copy()
    values[[25, 30], 2] = np.nan
    element = "joint3" if column in ("joints", "commands") else "z"
    with pytest.raises(
        ValueError, match=rf"is not finite in 2 frames, first {element} in episode 4, frame 5"
    ):
        check(**{column: values})


def test_units_and_orders_are_refused_with_the_column_and_the_remedy():
    poses = array_chain(ARM).pose(JOINTS)
    millimetres = poses * [1000, 1000, 1000, 1, 1, 1, 1]
    with pytest.raises(ValueError, match=r"here: observation.state: joint\d .*degrees.*Remedy: --units"):
        check(joints=np.degrees(JOINTS), where="here", joints_remedy="--units")
    with pytest.raises(ValueError, match=r"action: joint\d .* rad .*Remedy: --units"):
        check(commands=np.degrees(JOINTS), joints_remedy="--units")
    with pytest.raises(ValueError, match=r"ee_target: .*millimetres.*metres"):
        check(target=millimetres)
    with pytest.raises(ValueError, match=r"ee_pose: .*w x y z.*x y z w"):
        check(current=poses[:, [0, 1, 2, 6, 3, 4, 5]])


def test_arms_are_told_apart_by_their_axes_not_by_links_tools_or_limits():
    piper = describe_arm("piper")
    assert ARM.joint_names == piper.joint_names
    assert "apart" in why_not_same_arm(ARM, piper)
    narrower = ARM.urdf.replace('upper="2.0944"', 'upper="2.0"').replace("end_link", "flange")
    assert narrower != ARM.urdf
    same = describe_arm(narrower, tip_link="flange", tool_offset=[0.1, 0, 0])
    assert why_not_same_arm(ARM, same) is None
    other = describe_arm(ARM.urdf, tip_link="end_link", joint_names=ARM.joint_names[::-1])
    assert "joints joint1" in why_not_same_arm(ARM, other)
