"""A simulated OpenArm behind LeRobot's own, unchanged driver, alone and inside the end-effector face."""

import itertools
import json
import time

import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
from lerobot.robots.openarm_follower import OpenArmFollowerConfig
from lerobot.robots.utils import make_robot_from_config
from pace import judged_by_the_pace

from robot_adapters.adapter import IKStatus
from robot_adapters.can.bus import open_bus
from robot_adapters.robots.config_mimicik_ee import MimicIKEEConfig
from robot_adapters.simulation.openarm import SimulatedOpenArm

JOINTS = [f"joint_{i}.pos" for i in range(1, 8)]
BENT = [0.0, 0.2, 0.0, 1.4, 0.0, 0.0, 0.0]
_channels = (f"openarm-{number}" for number in itertools.count())


@pytest.fixture
def cell(tmp_path):
    """A running simulated arm, and the configuration of LeRobot's driver for it; calibrated, as after its dialogue."""
    channel = next(_channels)
    entry = {"drive_mode": 0, "homing_offset": 0, "range_min": -90, "range_max": 90}
    names = [*(key.removesuffix(".pos") for key in JOINTS), "gripper"]
    (tmp_path / "one.json").write_text(
        json.dumps({name: entry | {"id": number} for number, name in enumerate(names, start=1)})
    )
    config = OpenArmFollowerConfig(
        id="one",
        calibration_dir=tmp_path,
        port=channel,
        can_interface="virtual",
        use_can_fd=False,
        side="right",
    )
    bus = open_bus("virtual", channel)
    with SimulatedOpenArm(bus, "right", BENT) as arm:
        yield arm, config
    bus.shutdown()


def settled(move, done):
    """Call `move` every 20 ms until `done`, as often as a busy machine takes; the minute is no verdict, only an end."""
    until = time.monotonic() + 60
    while not done() and time.monotonic() < until:
        move()
        time.sleep(0.02)


def test_lerobots_driver_moves_it(cell):
    arm, config = cell
    robot = make_robot_from_config(config)
    with judged_by_the_pace():
        robot.connect()
        target = dict(zip(JOINTS, np.degrees(BENT) + 5.0, strict=True)) | {"gripper.pos": -30.0}
        settled(
            lambda: robot.send_action(target),
            lambda: np.degrees(arm.gripper_angle) == pytest.approx(-30.0, abs=1.0),
        )
        for _ in range(20):
            robot.send_action(target)
            time.sleep(0.02)
        seen = robot.get_observation()
        # Without gravity torques it hangs below its command by the load over the stiffness that LeRobot gives it.
        np.testing.assert_allclose([seen[key] for key in JOINTS], [target[key] for key in JOINTS], atol=6.0)
        np.testing.assert_allclose(np.radians([seen[key] for key in JOINTS]), arm.q, atol=0.05)
        assert np.degrees(arm.gripper_angle) == pytest.approx(-30.0, abs=3.0)
        robot.disconnect()
    # The arm's thread may still have the last frames to read.
    settled(lambda: None, lambda: not any(motor.enabled for motor in arm.motors.values()))
    assert not any(motor.enabled for motor in arm.motors.values())


def test_inside_the_face_it_takes_poses(cell, tmp_path):
    arm, config = cell
    robot = make_robot_from_config(MimicIKEEConfig(arm=config, calibration_dir=tmp_path))
    assert robot.sides[""][0].description == arm.description
    with judged_by_the_pace():
        robot.connect()
        start = robot.get_observation()
        for frame in range(50):
            robot.get_observation()
            sent = robot.send_action(start | {"ee.z.pos": start["ee.z.pos"] + 0.05 * min(frame / 25, 1.0)})
            time.sleep(0.02)
        assert robot.results[""].status is IKStatus.REACHED
        assert sent["ee.z.pos"] - start["ee.z.pos"] == pytest.approx(0.05, abs=2e-3)
        up = start | {"ee.z.pos": start["ee.z.pos"] + 0.05}
        settled(
            lambda: robot.send_action(up),
            lambda: robot.get_observation()["ee.z.pos"] - start["ee.z.pos"] > 0.02,
        )
        assert robot.get_observation()["ee.z.pos"] - start["ee.z.pos"] > 0.02
        robot.disconnect()
