"""The AIRBOT Play as LeRobot robots: features, units, limits, two arms, cameras, and errors that name the thing."""

import base64
import importlib
import json
import logging
import threading
import time
from functools import partial

import cv2
import draccus
import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
import zmq
from evaluation_cases import airbot
from lerobot.cameras.zmq import ZMQCameraConfig
from lerobot.robots.config import RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config
from serving_cases import serving

from lerobot_mimicik.solvers import make_solver
from robot_adapters.clock import PatientClock, RealClock
from robot_adapters.ik_options import IKOptions
from robot_adapters.robots.airbot_play import open_arm
from robot_adapters.robots.config_airbot_play import (
    AirbotConnection,
    AirbotPlayConfig,
    AirbotPlayEEConfig,
    BiAirbotPlayConfig,
    BiAirbotPlayEEConfig,
)
from robot_adapters.robots.config_recorded_motion import RecordedMotionConfig
from robot_adapters.safety import CommandStatus

# The simulated arm waits for a busy computer; its time passes in `wait`.
VIRTUAL = {"interface": "virtual", "real_time": False}
JOINTS = [f"joint{i}.pos" for i in range(1, 7)]


@pytest.fixture
def connected(tmp_path):
    """A function that makes and connects a robot; all are disconnected at the end."""
    robots = []

    def connect(config):
        config.calibration_dir = tmp_path
        robot = make_robot_from_config(config)
        robots.append(robot)
        robot.connect()
        return robot

    yield connect
    for robot in robots:
        if robot.is_connected:
            robot.disconnect()


def wait(robot, seconds: float) -> None:
    """Lets simulated time pass for the robot's arm, or for both."""
    for arm in (robot.left_arm, robot.right_arm) if hasattr(robot, "left_arm") else (robot,):
        arm.arm.clock.sleep(seconds)


def follow(robot, key: str, change: float, frames: int = 12) -> dict:
    """Moves one number smoothly, and holds there until most of the way is made; what was sent last."""
    start = robot.get_observation()
    for frame in range(1, frames + 40):
        action = {name: start[name] for name in robot.action_features}
        action[key] += change * min(frame / frames, 1.0)
        sent = robot.send_action(action)
        wait(robot, 0.05)
        if frame >= frames and abs(robot.get_observation()[key] - start[key]) > 0.8 * abs(change):
            break
    return sent


def test_registered_under_their_names():
    known = RobotConfig.get_known_choices()
    for name in ("airbot_play", "airbot_play_ee", "bi_airbot_play", "bi_airbot_play_ee"):
        own = name.replace("airbot_play", "airbot_play_can")
        assert known[own] is known[name]
        assert known[own]().type == own


def test_a_virtual_arm_runs_in_real_time_unless_it_shall_wait_for_the_computer():
    for options, clock in (({}, RealClock), ({"real_time": False}, PatientClock)):
        _, cell = open_arm(AirbotConnection(interface="virtual", **options))
        with cell:
            assert type(cell.clock) is clock


@pytest.mark.parametrize("units", ["rad", "deg"])
def test_joint_space(connected, units):
    robot = connected(AirbotPlayConfig(**VIRTUAL, joint_units=units))
    assert list(robot.action_features) == [*JOINTS, "gripper.pos"]
    observation = robot.get_observation()
    assert set(observation) == set(robot.observation_features)
    one = 1.0 if units == "rad" else np.degrees(1.0)
    np.testing.assert_allclose([observation[key] / one for key in JOINTS], robot.simulation.q, atol=2e-3)
    sent = follow(robot, "joint6.pos", 0.3 * one)
    assert sent["joint6.pos"] / one == pytest.approx(robot.arm.target()[5], abs=1e-6)
    assert robot.simulation.q[5] - observation["joint6.pos"] / one > 0.15
    assert robot.simulation.warnings == 0


def test_without_a_gripper(connected):
    robot = connected(AirbotPlayConfig(**VIRTUAL, gripper=False))
    assert list(robot.action_features) == JOINTS
    assert set(robot.send_action(robot.get_observation())) == set(JOINTS)


def test_a_jump_is_refused_and_reported_or_walked_to(connected, caplog):
    with caplog.at_level(logging.WARNING):
        robot = connected(AirbotPlayConfig(**VIRTUAL, gripper=False))
        start = robot.get_observation()
        far = start | {"joint1.pos": start["joint1.pos"] + 1.0}
        sent = robot.send_action(far)
        assert robot.result.status is CommandStatus.REFUSED
        assert sent["joint1.pos"] == pytest.approx(start["joint1.pos"], abs=5e-3)
        assert "JumpViolation" in caplog.text
    robot = connected(AirbotPlayConfig(**VIRTUAL, gripper=False, max_relative_target=0.05))
    before = robot.get_observation()["joint1.pos"]
    sent = [robot.send_action(far)["joint1.pos"] for _ in range(1)]
    assert sent[0] - before == pytest.approx(0.05, abs=5e-3)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["airbot_play", "--robot.joint_units=degrees"], "joint_units='degrees': expected 'rad' or 'deg'"),
        (
            ["airbot_play_ee", "--robot.rotation=rot6d"],
            "'rot6d' is no pose format: expected one of quaternion, ",
        ),
        (["airbot_play_ee", "--robot.ik.max_step=-1"], "max_step must be finite and positive"),
        (["airbot_play_ee", "--robot.tool=[0,0,0]"], r"tool=\[0.0, 0.0, 0.0\]: expected poses of 7 numbers"),
        (
            ["bi_airbot_play", "--robot.left.max_relative_target=9"],
            "max_relative_target=9.0: expected more than 0",
        ),
        (["bi_airbot_play_ee", "--robot.ik.reference=felt"], "reference='felt': expected"),
    ],
)
@pytest.mark.parametrize(
    "command", ["lerobot_rollout:RolloutConfig", "lerobot_teleoperate:TeleoperateConfig"]
)
def test_lerobot_commands_tell_why_a_robots_option_is_refused(command, arguments, reason):
    script, name = command.split(":")
    config = getattr(importlib.import_module(f"lerobot.scripts.{script}"), name)
    teleoperator = ["--teleop.type=recorded_motion"] if script == "lerobot_teleoperate" else []
    with pytest.raises(draccus.utils.DecodingError, match=reason):  # LeRobot prints its text
        draccus.parse(config, args=[f"--robot.type={arguments[0]}", *arguments[1:], *teleoperator])


def test_errors_name_the_thing(connected, tmp_path):
    with pytest.raises(ValueError, match="joint_units='turns'"):
        AirbotPlayConfig(joint_units="turns")
    with pytest.raises(ValueError, match="max_relative_target"):
        AirbotPlayConfig(max_relative_target=2.0)
    with pytest.raises(ValueError, match="euler"):
        AirbotPlayEEConfig(rotation="euler")
    ik = IKOptions(path="here", address="tcp://there:1")
    robot = make_robot_from_config(AirbotPlayEEConfig(**VIRTUAL, ik=ik, calibration_dir=tmp_path))
    with pytest.raises(ValueError, match="which of the two"):
        robot.connect()
    assert not robot.is_connected
    robot = connected(AirbotPlayConfig(**VIRTUAL, gripper=False))
    with pytest.raises(KeyError, match=r"joint3\.pos"):
        robot.send_action({key: 0.0 for key in JOINTS if key != "joint3.pos"})


def test_an_interface_that_does_not_exist_says_what_to_do(tmp_path):
    robot = make_robot_from_config(
        AirbotPlayConfig(interface="slcan", channel="/dev/does-not-exist", calibration_dir=tmp_path)
    )
    with pytest.raises(OSError, match="does-not-exist"):
        robot.connect()
    assert not robot.is_connected


@pytest.mark.parametrize(
    ("rotation", "learned"), [("quaternion", True), ("rotation_vector", False), ("rotation_6d", False)]
)
def test_end_effector_space_with_a_checkpoint_and_without(connected, mimicik_run, rotation, learned):
    ik = IKOptions(path=str(mimicik_run)) if learned else IKOptions()
    robot = connected(AirbotPlayEEConfig(**VIRTUAL, ik=ik, rotation=rotation))
    assert list(robot.action_features)[:3] == ["ee.x.pos", "ee.y.pos", "ee.z.pos"]
    assert list(robot.action_features)[-1] == "ee.gripper.pos"
    before = robot.get_observation()
    np.testing.assert_allclose(
        [before[f"ee.{axis}.pos"] for axis in "xyz"], robot.adapter.forward(robot.simulation.q)[:3], atol=2e-3
    )
    follow(robot, "ee.z.pos", 0.05, frames=20)
    after = robot.get_observation()
    assert after["ee.z.pos"] - before["ee.z.pos"] > 0.03
    assert abs(after["ee.x.pos"] - before["ee.x.pos"]) < 0.01
    assert robot.simulation.warnings == 0
    assert robot.ik_result is not None
    assert learned or robot.ik_result.source == "guided"


def test_the_ik_may_answer_from_another_computer(connected):
    solvers = {"mink": partial(make_solver, "mink", airbot())}
    with serving(solvers) as server:
        ik = IKOptions(address=server.address, solver="mink")
        robot = connected(AirbotPlayEEConfig(**VIRTUAL, gripper=False, ik=ik))
        before = robot.get_observation()["ee.z.pos"]
        follow(robot, "ee.z.pos", 0.03)
        assert robot.get_observation()["ee.z.pos"] - before > 0.02
        robot.disconnect()


def test_a_pose_that_is_none_holds_the_arm(connected, mimicik_run, caplog):
    robot = connected(AirbotPlayEEConfig(**VIRTUAL, gripper=False, ik=IKOptions(path=str(mimicik_run))))
    before = robot.arm.target()
    with caplog.at_level(logging.WARNING):
        robot.send_action(dict.fromkeys(robot.action_features, 0.0))
    assert "no rotation" in caplog.text
    np.testing.assert_allclose(robot.arm.target(), before, atol=5e-3)


def test_two_arms(connected):
    virtual = AirbotConnection(**VIRTUAL, gripper=False)
    robot = connected(BiAirbotPlayConfig(left=virtual, right=virtual))
    assert list(robot.action_features) == [f"{side}_{key}" for side in ("left", "right") for key in JOINTS]
    follow(robot, "left_joint6.pos", 0.2)
    moved = [arm.simulation.q[5] + 1.5708 for arm in (robot.left_arm, robot.right_arm)]
    assert moved[0] > 0.1
    assert abs(moved[1]) < 0.01
    with pytest.raises(KeyError, match=r"right arm: .*joint1\.pos"):
        robot.send_action({f"left_{key}": 0.0 for key in JOINTS})


def test_two_arms_in_end_effector_space(connected, mimicik_run):
    virtual = AirbotConnection(**VIRTUAL)
    robot = connected(BiAirbotPlayEEConfig(left=virtual, right=virtual, ik=IKOptions(path=str(mimicik_run))))
    observation = robot.get_observation()
    assert {"left_ee.x.pos", "right_ee.qw.pos", "right_ee.gripper.pos"} <= set(observation)
    sent = robot.send_action({key: observation[key] for key in robot.action_features})
    assert sent["right_ee.x.pos"] == pytest.approx(observation["right_ee.x.pos"], abs=5e-3)


def test_two_arms_close_when_one_does_not_answer(tmp_path):
    robot = make_robot_from_config(
        BiAirbotPlayConfig(
            left=AirbotConnection(**VIRTUAL),
            right=AirbotConnection(interface="virtual-nowhere"),
            calibration_dir=tmp_path,
        )
    )
    with pytest.raises(OSError, match="virtual-nowhere"):
        robot.connect()
    assert not robot.left_arm.is_connected


@pytest.fixture
def image_server():
    """Port of a publisher of grey images, as LeRobot's network camera takes them."""
    stop = threading.Event()
    socket = zmq.Context.instance().socket(zmq.PUB)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    encoded, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))
    assert encoded
    message = json.dumps({"timestamps": {}, "images": {"wrist": base64.b64encode(jpeg).decode()}})

    def publish():
        while not stop.wait(0.03):
            socket.send_string(message)

    thread = threading.Thread(target=publish)
    thread.start()
    yield port
    stop.set()
    thread.join()
    socket.close()


@pytest.mark.parametrize("two", [False, True])
def test_lerobots_own_cameras_attach(connected, image_server, two):
    camera = ZMQCameraConfig(
        server_address="127.0.0.1", port=image_server, camera_name="wrist", width=64, height=48, fps=30
    )
    virtual = AirbotConnection(**VIRTUAL, gripper=False)
    config = (
        BiAirbotPlayConfig(left=virtual, right=virtual, cameras={"wrist": camera})
        if two
        else AirbotPlayConfig(**VIRTUAL, gripper=False, cameras={"wrist": camera})
    )
    robot = connected(config)
    assert robot.observation_features["wrist"] == (48, 64, 3)
    image = robot.get_observation()["wrist"]
    assert image.shape == (48, 64, 3)
    assert np.abs(image.astype(int) - 90).max() < 5
    camera = robot.cameras["wrist"]
    robot.disconnect()
    assert not camera.is_connected


def test_recorded_motion_plays_an_episode(mimicik_run, tmp_path):
    root = str(mimicik_run.parent / "data" / "test")

    def teleoperator(**options):
        return make_teleoperator_from_config(
            RecordedMotionConfig(**{"dataset_root": root, "calibration_dir": tmp_path} | options)
        )

    player = teleoperator(column="observation.ee_target", gripper=0.02)
    assert next(iter(player.action_features)) == "ee.x.pos"
    assert list(player.action_features)[-1] == "ee.gripper.pos"
    player.connect()
    first = player.get_action()
    time.sleep(0.2)
    assert player.get_action() != first
    player.disconnect()
    for options, message in (
        ({"column": "observation.force"}, r"observation\.force"),
        ({"episode": 999}, "episode 999"),
    ):
        with pytest.raises(ValueError, match=message):
            _ = teleoperator(**options).action_features


@pytest.mark.parametrize("root", ["", "nowhere"])
def test_recorded_motion_of_no_dataset_is_refused_before_a_robot_is_connected(root, tmp_path):
    with pytest.raises(ValueError, match=rf"dataset_root='{root}' is no LeRobot dataset"):
        make_teleoperator_from_config(RecordedMotionConfig(dataset_root=root, calibration_dir=tmp_path))
