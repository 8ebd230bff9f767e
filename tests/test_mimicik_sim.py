"""Any arm simulated as a LeRobot robot: units, lag, sag, noise, time, and errors that name the thing."""

from urllib.request import urlopen

import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
from lerobot.robots.utils import make_robot_from_config

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig
from robot_adapters.robots.units import JointUnits
from robot_adapters.simulation.servo_arm import ServoArm, ServoParameters


@pytest.fixture
def connected(tmp_path):
    """A function that makes and connects a simulated arm whose time passes with its actions."""

    def connect(arm="piper", **options):
        robot = make_robot_from_config(
            MimicIKSimConfig(**{"arm": arm, "real_time": False, "calibration_dir": tmp_path} | options)
        )
        robot.connect()
        return robot

    return connect


def joints(robot, positions):
    return np.array([positions[key] for key in robot.joint_keys])


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_every_shipped_arm_follows_and_hangs_below_its_command_by_no_more_than_the_sag(name):
    description = describe_arm(name)
    arm = ServoArm(description, parameters=ServoParameters(lag=0.05, sag=0.01, noise=0.0))
    start = arm.q
    np.testing.assert_allclose(start, arm.target, atol=0.011)
    target = np.clip(start + 0.2, arm.lower, arm.upper)
    arm.command(target)
    arm.advance(0.05)
    assert np.abs(arm.q - target).max() > 0.05  # it lags
    arm.advance(1.0)
    np.testing.assert_allclose(arm.q, target, atol=0.011)
    again = ServoArm(description, parameters=ServoParameters(lag=0.05, sag=0.01, noise=0.0))
    again.command(target)
    again.advance(1.05)
    np.testing.assert_allclose(arm.q, again.q, atol=1e-9)


def test_only_the_chain_of_a_drawing_counts():
    urdf = """<robot name="two"><link name="base"/><link name="a"><visual><geometry><mesh filename="none.stl"/>
    </geometry></visual></link><link name="tip"/><link name="finger"/>
    <joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
    <joint name="slide" type="prismatic"><parent link="a"/><child link="tip"/><origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
    <joint name="grip" type="continuous"><parent link="a"/><child link="finger"/><axis xyz="0 1 0"/></joint></robot>"""
    arm = ServoArm(describe_arm(urdf, tip_link="tip"))
    arm.command([0.4, 0.1])
    arm.advance(1.0)
    np.testing.assert_allclose(arm.q, [0.4, 0.1], atol=0.011)


@pytest.mark.parametrize("units", ["deg", "rad", "normalised"])
def test_units(connected, units):
    robot = connected(joint_units=units, noise=0.0)
    assert list(robot.action_features) == [*robot.joint_keys, "gripper.pos"]
    lower, upper = robot.ranges
    one = {"deg": 180 / np.pi, "rad": 1.0, "normalised": 200 / (upper - lower)}[units]
    start = robot.get_observation()
    wanted = joints(robot, start) + 0.1 * one
    sent = robot.send_action(dict(zip(robot.joint_keys, wanted, strict=True)) | {"gripper.pos": 120.0})
    np.testing.assert_allclose(joints(robot, sent), wanted, rtol=1e-9)
    assert sent["gripper.pos"] == 100.0
    for _ in range(30):
        robot.send_action(sent)
    moved = robot.servos.q - robot.servos.target
    assert np.abs(moved).max() < 0.011
    assert robot.get_observation()["gripper.pos"] == pytest.approx(100.0, abs=0.1)


def test_the_same_seed_and_actions_give_the_same_numbers_and_another_seed_other_noise(connected):
    def run(seed):
        robot = connected(seed=seed)
        seen = [robot.get_observation()]
        for _ in range(5):
            robot.send_action({key: value + 1.0 for key, value in seen[0].items()})
            seen.append(robot.get_observation())
        return np.array([list(each.values()) for each in seen])

    first = run(1)
    np.testing.assert_array_equal(first, run(1))
    assert 0 < np.abs(first - run(2))[:, :6].max() < 0.5


def test_in_real_time_it_moves_with_the_clock(connected, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("robot_adapters.robots.mimicik_sim.time.monotonic", lambda: now[0])
    robot = connected(real_time=True, noise=0.0)
    start = robot.get_observation()
    robot.send_action({key: value + 5.0 for key, value in start.items()})
    assert robot.get_observation()["joint1.pos"] == pytest.approx(start["joint1.pos"], abs=0.1)
    now[0] += 0.4
    assert robot.get_observation()["joint1.pos"] - start["joint1.pos"] > 4.0


def test_limits_hold_and_errors_name_the_thing(connected):
    robot = connected()
    start = robot.get_observation()
    sent = robot.send_action(start | {"joint1.pos": 1000.0})
    assert sent["joint1.pos"] == pytest.approx(np.degrees(robot.ranges[1][0]))
    with pytest.raises(ValueError, match="not finite"):
        robot.send_action(start | {"joint2.pos": float("nan")})
    with pytest.raises(KeyError, match=r"joint3\.pos"):
        robot.send_action({key: 0.0 for key in start if key != "joint3.pos"})
    for options, reason in (
        ({"joint_units": "turns"}, "joint_units='turns'"),
        ({"fps": 0}, "fps=0"),
    ):
        with pytest.raises(ValueError, match=reason):
            MimicIKSimConfig(**options)
    for options, reason in (
        ({"arm": "no_arm"}, "no_arm"),
        ({"lag": 0.0}, r"lag=0\.0"),
        ({"lag": 1e9}, "lag=1000000000"),  # it would hang on its servos in a century
        ({"sag": 10.0}, r"sag=10\.0"),
    ):
        with pytest.raises(ValueError, match=reason):
            make_robot_from_config(MimicIKSimConfig(**options))
    with pytest.raises(ValueError, match="start: expected 6"):
        connected(start=[0.0])
    with pytest.raises(ValueError, match="as degrees the numbers would fit"):
        connected(start=[0.0, 60.0, -90.0, 0.0, 0.0, 0.0])


def test_it_is_shown_in_the_browser_while_it_is_connected(connected):
    pytest.importorskip("viser")
    robot = connected(view=True, view_port=18080)
    robot.get_observation()
    address = robot._page.address
    assert urlopen(address).status == 200
    robot.disconnect()
    with pytest.raises(OSError, match="refused"):
        urlopen(address)


def test_units_there_and_back():
    lower, upper = np.array([-1.0, 2.0]), np.array([3.0, 0.5])
    for unit in ("deg", "rad", "normalised"):
        units = JointUnits(unit, lower, upper)
        np.testing.assert_allclose(units.to_rad(units.from_rad([0.3, 1.0])), [0.3, 1.0])
    np.testing.assert_allclose(JointUnits("normalised", lower, upper).to_rad([-100, 100]), [-1.0, 0.5])
    with pytest.raises(ValueError, match="does not tell"):
        JointUnits("normalised")
