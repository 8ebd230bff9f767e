"""The kinematics of shipped arms against models that others made of them."""

import importlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_mimicik.cli import arms as arms_command
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.shipped import SHIPPED, arm_of_robot_type

Q = np.array([0.3, -0.5, 0.4, 0.9, -0.6, 0.7, -0.2])
# Position [m] and rotation vector [rad] of a link at the first joints of Q, from the public description named.
PUBLISHED = {
    # TheRobotStudio/SO-ARM100, Simulation/SO101/so101_new_calib.urdf.
    ("so101", "gripper_frame_link"): ((0.270411, -0.067005, 0.128755), (1.08578, 2.114743, 0.167292)),
    # The same repository's Simulation/SO100/so100.urdf, turned by 90 degrees about z, at LeRobot's zero and senses:
    # its joints at -q1, q2 + 1.8, q3 - pi / 2, q4 + 1 - pi / 2, q5.
    ("so100", "gripper_link"): ((0.214086, -0.052243, 0.206744), None),
    # enactic/openarm_description at v1.0, urdf/robot/v10.urdf.xacro with bimanual:=true.
    ("openarm_right", "hand_tcp"): ((0.350451, 0.08061, 0.33038), (-2.232465, -0.5495, -1.101349)),
    ("openarm_left", "hand_tcp"): ((0.144248, 0.385543, 0.231353), (-2.26025, -0.105975, -0.84638)),
    # frankaemika/franka_ros, franka_description/robots/panda with its hand.
    ("panda", "panda_hand_tcp"): ((-0.241388, -0.219283, 0.805661), (1.444476, 0.671699, 2.49903)),
    # frankaemika/franka_description, robots/fr3.
    ("fr3", "fr3_link8"): ((-0.329862, -0.249571, 0.761541), (-1.464521, -0.062381, -2.217628)),
    # UniversalRobots/Universal_Robots_ROS2_Description, config/ur5e.
    ("ur5e", "tool0"): ((0.559682, 0.398709, 0.376292), (-0.387894, -1.133215, -0.876344)),
    # xArm-Developer/xarm_ros2, xarm_description/urdf/xarm6.
    ("xarm6", "link_eef"): ((0.121051, -0.058895, 0.179603), (-2.264663, 1.765771, -0.980169)),
    # google-deepmind/mujoco_menagerie, i2rt_yam/yam.xml.
    ("yam", "link_6"): ((-0.129912, -0.019322, 0.307078), (-0.672428, 0.489406, 2.392571)),
}
# Module of ssik, base and tip of its chain here. Its Piper has the manufacturer's former zero, 2 degrees from today's.
SSIK = {
    "panda": ("franka.panda_ik", "panda_link0", "panda_link8"),
    "fr3": ("franka.fr3_ik", "fr3_link0", "fr3_link8"),
    "ur5e": ("universal_robots.ur5e_ik", "base_link", "tool0"),
    "xarm6": ("ufactory.xarm6_ik", "link_base", "link_eef"),
    "yam": ("i2rt.yam_ik", "base_link", "link_6"),
    # OpenArm 2.0, whose wrist's axes stand otherwise, but meet in the same point.
    "openarm_right": ("openarm.right_ik", "link0", "link7"),
    "openarm_left": ("openarm.left_ik", "link0", "link7"),
}
# Public descriptions write right angles as 1.5708, which turns a tool by so much [rad].
ROUNDED = 3e-5


@pytest.mark.parametrize(("name", "tip"), PUBLISHED)
def test_a_pose_is_that_of_the_public_description(name, tip):
    position, turn = PUBLISHED[name, tip]
    arm = describe_arm(name, tip_link=tip)
    rotation, found = array_chain(arm).forward(Q[None, : len(arm.joint_names)])
    np.testing.assert_allclose(found[0], position, atol=1e-5)
    if turn is not None:
        error = Rotation.from_matrix(rotation[0]).inv() * Rotation.from_rotvec(turn)
        assert error.magnitude() < ROUNDED


@pytest.mark.parametrize("name", SSIK)
def test_forward_kinematics_are_those_of_ssik(name):
    pytest.importorskip("ssik", reason="ssik comes with the extra `bench`")
    module, base, tip = SSIK[name]
    model = importlib.import_module(f"ssik.prebuilt.{module}")
    arm = describe_arm(name, base_link=base, tip_link=tip)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (50, len(arm.joint_names)))
    rotation, position = array_chain(arm).forward(q)
    theirs = np.stack([np.asarray(model.fk(each)) for each in q])
    np.testing.assert_allclose(position, theirs[:, :3, 3], atol=1e-5)
    if not name.startswith("openarm"):
        np.testing.assert_allclose(rotation, theirs[:, :3, :3], atol=ROUNDED)


def test_a_robot_type_finds_its_arm():
    assert arm_of_robot_type("so101_follower") == "so101"
    assert arm_of_robot_type("openarm_follower", "left") == "openarm_left"
    assert arm_of_robot_type("bi_openarm_follower", "right") == arm_of_robot_type("openarm_follower")
    assert arm_of_robot_type("koch_follower") is None


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_joints_bear_the_names_and_limits_of_the_lerobot_robot(name):
    arm = describe_arm(name)
    if "so101_follower" in SHIPPED[name].robot_types or "so100_follower" in SHIPPED[name].robot_types:
        expected = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
        assert arm.joint_names == expected
    if "openarm_follower" in SHIPPED[name].robot_types:
        from lerobot.robots.openarm_follower import config_openarm_follower as config

        limits = getattr(config, f"{SHIPPED[name].side.upper()}_DEFAULT_JOINTS_LIMITS")
        found = {j.name: tuple(np.degrees([j.lower, j.upper]).round(3)) for j in arm.joints()}
        assert found == {joint: limit for joint, limit in limits.items() if joint != "gripper"}


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_the_rest_of_a_shipped_arm_is_within_its_limits_and_does_not_touch_itself(name):
    from test_arms import colliding_links

    arm = describe_arm(name)
    for joint, value in zip(arm.joints(), SHIPPED[name].rest, strict=True):
        assert joint.lower <= value <= joint.upper
    assert not colliding_links(arm.urdf, arm.joint_names, np.array([SHIPPED[name].rest]))


def test_the_command_lists_every_arm_and_shows_one(capsys):
    arms_command.main([])
    listing = capsys.readouterr().out
    assert all(f"\n{name} " in listing for name in SHIPPED_ARMS)
    assert "so101_follower" in listing
    arms_command.main(["--arm=so101"])
    shown = capsys.readouterr().out
    assert "shoulder_pan" in shown
    assert "-1.920" in shown


def test_a_urdf_of_ones_own_is_shown_without_a_home(tmp_path, capsys):
    (tmp_path / "mine.urdf").write_text(describe_arm("piper").urdf)
    arms_command.main([f"--arm={tmp_path / 'mine.urdf'}"])
    assert "No home is given" in capsys.readouterr().out


def test_the_reach_of_two_links_is_their_length():
    joints = "".join(
        f'<link name="l{i}"/><joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for i, x in ((1, 5.0), (2, 0.3))
    )
    urdf = (
        f'<robot name="r"><link name="l0"/>{joints}<link name="t"/><joint name="t" type="fixed"><parent link="l2"/>'
        '<child link="t"/><origin xyz="0.2 0 0"/></joint></robot>'
    )
    assert arms_command.reach(describe_arm(urdf)) == pytest.approx(0.5, abs=1e-3)
