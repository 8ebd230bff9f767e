"""The end-effector face around LeRobot robots: features, units, safety, keyboards, two arms, and what is said."""

import importlib
import json

import draccus
import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
from lerobot.cameras.zmq import ZMQCameraConfig
from lerobot.robots.bi_openarm_follower import BiOpenArmFollowerConfig
from lerobot.robots.config import RobotConfig
from lerobot.robots.openarm_follower import OpenArmFollowerConfig, OpenArmFollowerConfigBase
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.robots.utils import make_robot_from_config

from lerobot_mimicik.foresight.weights import SHIPPED
from lerobot_mimicik.kinematics.arms import describe_arm
from robot_adapters.adapter import IKStatus
from robot_adapters.ik_options import IKOptions
from robot_adapters.robots.config_airbot_play import AirbotConnection, BiAirbotPlayConfig
from robot_adapters.robots.config_mimicik_ee import JointRobot, MimicIKEEConfig
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig
from robot_adapters.robots.joint_offsets import write_offsets

NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
FIVE = (
    "<robot name='five'><link name='l0'/>"
    + "".join(
        f"<link name='l{i + 1}'/><joint name='{name}' type='revolute'><parent link='l{i}'/><child link='l{i + 1}'/>"
        f"<origin xyz='0 0 0.1'/><axis xyz='{axis}'/><limit lower='-2' upper='2' effort='1' velocity='1'/></joint>"
        for i, (name, axis) in enumerate(
            zip(NAMES, ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1"), strict=True)
        )
    )
    + "</robot>"
)
STILL = {"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1.0}


@pytest.fixture
def faced(tmp_path):
    """A function that puts the face before a simulated arm, and connects it."""

    def connect(inner=None, **options):
        sim = inner or MimicIKSimConfig(arm="piper", real_time=False)
        sim.calibration_dir = tmp_path
        robot = make_robot_from_config(MimicIKEEConfig(arm=sim, calibration_dir=tmp_path, **options))
        robot.connect()
        return robot

    return connect


def lead(robot, action, frames=1):
    """Sends the same action for some frames; the last pose sent."""
    for _ in range(frames):
        robot.get_observation()
        sent = robot.send_action(action)
    return sent


@pytest.mark.parametrize(
    ("command", "others"),
    [
        (
            "record:RecordConfig",
            ["--dataset.repo_id=a/b", "--dataset.single_task=t", "--teleop.type=keyboard_ee"],
        ),
        ("replay:ReplayConfig", ["--dataset.repo_id=a/b", "--dataset.episode=0"]),
        ("teleoperate:TeleoperateConfig", ["--teleop.type=recorded_motion"]),
    ],
)
def test_lerobots_commands_and_json_take_any_robot_inside(command, others):
    script, name = command.split(":")
    config = getattr(importlib.import_module(f"lerobot.scripts.lerobot_{script}"), name)
    face = ["--robot.type=mimicik_ee", "--robot.ik.max_step=0.05"]
    inner = ["--robot.arm.type=so101_follower", "--robot.arm.port=/dev/tty1"]
    parsed = draccus.parse(config, args=[*face, *inner, *others]).robot
    assert isinstance(parsed.arm, SO101FollowerConfig)
    assert parsed.arm.type == "so101_follower"
    assert (parsed.arm.port, parsed.ik.max_step) == ("/dev/tty1", 0.05)
    encoded = json.loads(json.dumps(draccus.encode(parsed, RobotConfig)))
    assert draccus.decode(RobotConfig, encoded) == parsed


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ([], "which robot is inside"),
        (["--robot.arm.type=so101_follower"], "port"),
        (["--robot.arm.type=mimicik_sim", "--robot.arm.joint_units=turns"], "joint_units='turns'"),
        (["--robot.arm.type=mimicik_sim", "--robot.keys=umi"], "keys='umi'"),
        (["--robot.arm.type=mimicik_sim", "--robot.delta_step=1"], "delta_step=1.0"),
        (["--robot.arm.type=mimicik_sim", "--robot.ik.max_step=-1"], "max_step must be finite"),
    ],
)
def test_lerobots_commands_tell_what_is_wrong(options, reason):
    config = importlib.import_module("lerobot.scripts.lerobot_teleoperate").TeleoperateConfig
    with pytest.raises(draccus.utils.DecodingError, match=reason):
        draccus.parse(config, args=["--robot.type=mimicik_ee", *options, "--teleop.type=recorded_motion"])


def test_a_face_is_not_offered_inside_a_face():
    assert {"so101_follower", "mimicik_sim"} <= set(JointRobot.get_known_choices())
    assert not {"mimicik_ee", "airbot_play_ee"} & set(JointRobot.get_known_choices())


@pytest.mark.parametrize("units", ["deg", "rad", "normalised"])
@pytest.mark.parametrize("keys", ["pos", "lerobot"])
def test_poses_in_poses_out_whatever_the_units_of_the_robot_inside(faced, units, keys):
    robot = faced(MimicIKSimConfig(arm="piper", joint_units=units, real_time=False, noise=0.0), keys=keys)
    names = (
        ["ee.x", "ee.wz", "ee.gripper_pos"]
        if keys == "lerobot"
        else ["ee.x.pos", "ee.qw.pos", "ee.gripper.pos"]
    )
    assert [list(robot.action_features)[i] for i in (0, -2, -1)] == names
    before = robot.get_observation()
    assert set(before) == set(robot.observation_features) == set(robot.action_features)
    up = "ee.z" if keys == "lerobot" else "ee.z.pos"
    for frame in range(40):
        sent = robot.send_action(before | {up: before[up] + 0.04 * min((frame + 1) / 20, 1.0)})
        robot.get_observation()
    assert robot.results[""].status is IKStatus.REACHED
    assert sent[up] - before[up] == pytest.approx(0.04, abs=1e-4)
    assert robot.get_observation()[up] - before[up] == pytest.approx(0.04, abs=0.005)


def test_actions_come_in_the_spellings_of_lerobot_and_of_the_airbot_datasets(faced):
    robot = faced(gripper=False)
    seen = robot.get_observation()
    pose = {key.split(".")[1]: value for key, value in seen.items()}
    for spelled in (
        {f"eef.{key}": each for key, each in pose.items()},
        {f"eef_{key}.pos": each for key, each in pose.items()},
    ):
        assert robot.send_action(spelled)["ee.x.pos"] == pytest.approx(pose["x"], abs=1e-3)
    vector = {f"ee.{key}": pose[key] for key in "xyz"} | {"ee.wx": 0.0, "ee.wy": 2.4, "ee.wz": 0.0}
    robot.send_action(vector)
    assert robot.results[""].status is not IKStatus.FAILED
    with pytest.raises(KeyError, match=r"ee\.y\.pos"):
        robot.send_action({"ee.x.pos": 0.3})


def test_no_joint_moves_by_more_than_a_step_and_nonsense_holds(faced, caplog):
    robot = faced(MimicIKSimConfig(arm="piper", joint_units="rad", real_time=False, noise=0.0))
    start = robot.get_observation()
    commands = []
    for action in (
        *[start | {"ee.x.pos": 0.1, "ee.y.pos": 0.3}] * 5,
        start | {"ee.x.pos": float("nan")},
        start,
    ):
        robot.send_action(action)
        commands.append(robot.arm.servos.target)
    assert np.abs(np.diff(commands, axis=0)).max() <= 0.095 + 1e-9
    np.testing.assert_array_equal(commands[-2], commands[-3])  # not finite: it holds
    assert np.abs(np.diff(commands[:5], axis=0)).max() > 0.05


def test_an_idle_arm_does_not_sag_and_a_keyboard_leads_from_the_command(faced):
    robot = faced(MimicIKSimConfig(arm="piper", real_time=False, sag=0.03))
    lead(robot, STILL)
    held = robot.arm.servos.target
    lead(robot, STILL, 100)
    np.testing.assert_allclose(robot.arm.servos.target, held, atol=1e-4)
    before = robot.send_action(STILL)
    lead(robot, STILL | {"delta_z": 1.0, "gripper": 2}, 20)
    after = lead(robot, STILL, 5)
    assert after["ee.z.pos"] - before["ee.z.pos"] == pytest.approx(0.04, abs=1e-3)
    assert after["ee.gripper.pos"] == pytest.approx(90.0)
    # At the end of its reach the target waits for the arm, and comes back at once.
    lead(robot, STILL | {"delta_x": 1.0}, 300)
    far = lead(robot, STILL)
    back = lead(robot, STILL | {"delta_x": -1.0}, 40)
    assert far["ee.x.pos"] - back["ee.x.pos"] > 0.02


def test_cameras_of_the_robot_inside_pass_through(tmp_path):
    camera = ZMQCameraConfig(server_address="127.0.0.1", camera_name="front", width=64, height=48, fps=30)
    inner = MimicIKSimConfig(arm="so101", cameras={"front": camera}, calibration_dir=tmp_path)
    robot = make_robot_from_config(MimicIKEEConfig(arm=inner, calibration_dir=tmp_path))
    assert robot.observation_features["front"] == (48, 64, 3)
    assert "front" not in robot.action_features
    assert robot.cameras is robot.arm.cameras  # where LeRobot looks for them


def test_a_gamepad_without_a_gripper_leaves_it_alone(faced):
    robot = faced()
    before = lead(robot, STILL)
    after = lead(robot, {key: np.float32(value) for key, value in STILL.items() if key != "gripper"}, 5)
    assert after["ee.gripper.pos"] == before["ee.gripper.pos"]


def test_seven_joints_have_a_posture_to_choose(faced):
    posture = list(describe_arm("panda").home)
    posture[2] += 0.6  # which turns the elbow about the line from shoulder to wrist
    q = []
    for ik in (IKOptions(), IKOptions(posture=posture)):
        robot = faced(MimicIKSimConfig(arm="panda", real_time=False), ik=ik, gripper=False)
        pose = lead(robot, robot.get_observation())
        after = lead(robot, pose, 60)
        np.testing.assert_allclose(list(after.values()), list(pose.values()), atol=1e-3)
        q.append(robot.arm.servos.target)
    assert q[1][2] - q[0][2] > 0.05


def test_steps_of_a_keyboard_can_be_recorded(faced):
    robot = faced(keys="delta")
    assert list(robot.action_features) == ["delta_x", "delta_y", "delta_z", "gripper"]
    assert "ee.x.pos" in robot.observation_features
    robot.send_action(dict.fromkeys(robot.action_features, 1.0))


def test_what_lerobot_blends_of_two_signs_of_a_quaternion_does_not_turn_the_tool(faced):
    robot = faced(gripper=False)
    seen = robot.get_observation()
    lead(robot, seen)
    quaternion = [key for key in seen if ".q" in key]
    turned = seen | {key: -seen[key] for key in quaternion}
    for t in np.linspace(0.0, 1.0, 31):
        lead(robot, {key: (1 - t) * seen[key] + t * turned[key] for key in seen})
        assert robot.results[""].rotation_error < 0.01 or robot.results[""].status is IKStatus.FAILED
        assert robot.results[""].step < 0.02


def test_offsets_lie_between_the_robot_and_its_drawing(faced, tmp_path):
    inner = MimicIKSimConfig(id="mine", arm="piper", real_time=False, noise=0.0, sag=1e-4)
    offsets = np.array([0.05, -0.03, 0.0, 0.1, 0.0, -0.2])
    write_offsets(tmp_path / "mine.offsets.json", [f"joint{i}" for i in range(1, 7)], offsets)
    robot = faced(inner)
    (arm, face), q = robot.sides[""], robot.arm.servos.q
    pose = face.adapter.forward(q + offsets)
    assert robot.get_observation()["ee.x.pos"] == pytest.approx(pose[0], abs=1e-4)
    sent = arm.action(q + offsets, None)
    np.testing.assert_allclose(np.radians([sent[key] for key in arm.joint_keys]), q, atol=1e-9)
    (tmp_path / "mine.offsets.json").write_text("{}")
    with pytest.raises(ValueError, match="mimicik calibrate"):
        faced(inner)


def test_two_arms(tmp_path):
    virtual = AirbotConnection(interface="virtual", real_time=False)
    inner = BiAirbotPlayConfig(left=virtual, right=virtual, calibration_dir=tmp_path)
    robot = make_robot_from_config(MimicIKEEConfig(arm=inner, calibration_dir=tmp_path))
    robot.connect()
    try:
        seen = robot.get_observation()
        assert {"left_ee.x.pos", "right_ee.qw.pos", "right_ee.gripper.pos"} <= set(seen)
        sent = lead(
            robot,
            {key: seen[key] for key in robot.action_features}
            | {"left_ee.z.pos": seen["left_ee.z.pos"] + 0.01},
        )
        assert sent["left_ee.z.pos"] - seen["left_ee.z.pos"] > 0.005
        assert sent["right_ee.z.pos"] == pytest.approx(seen["right_ee.z.pos"], abs=1e-3)
        with pytest.raises(KeyError, match=r"right_ee\.x\.pos"):
            robot.send_action({key: value for key, value in seen.items() if key.startswith("left_")})
    finally:
        robot.disconnect()


def test_a_robot_of_lerobot_says_its_joints_and_units(tmp_path):
    def arm(**options):
        inner = SO101FollowerConfig(port="/dev/none", id="so", calibration_dir=tmp_path, **options)
        robot = make_robot_from_config(
            MimicIKEEConfig(arm=inner, arm_description=FIVE, calibration_dir=tmp_path)
        )
        return robot.sides[""][0]

    degrees = arm()
    assert degrees.gripper_key == "gripper.pos"
    assert degrees.units.unit == "deg"
    with pytest.raises(ValueError, match="lerobot-calibrate"):
        _ = arm(use_degrees=False).units
    entry = {"drive_mode": 0, "homing_offset": 0, "range_min": 1024, "range_max": 3072}
    names = [*degrees.description.joint_names, "gripper"]
    (tmp_path / "so.json").write_text(json.dumps({name: entry | {"id": i} for i, name in enumerate(names)}))
    normalised = arm(use_degrees=False)
    np.testing.assert_allclose(normalised.units.to_rad([100.0] * 5), np.pi / 2, rtol=1e-3)


@pytest.mark.parametrize("chosen", ["so100_follower", "so101_follower"])
def test_the_shipped_arm_of_a_robot_type(tmp_path, chosen):
    config = draccus.decode(
        RobotConfig,
        {
            "type": "mimicik_ee",
            "arm": {"type": chosen, "port": "/dev/none", "calibration_dir": str(tmp_path)},
        },
    )
    robot = make_robot_from_config(config)
    (arm, _) = robot.sides[""]
    assert arm.description == describe_arm(chosen.removesuffix("_follower"))
    with pytest.raises(ValueError, match="so100 or so101"):
        make_robot_from_config(MimicIKEEConfig(arm=SO101FollowerConfig(port="/dev/none")))


def test_both_sides_of_a_pair_are_their_own_arms(tmp_path):
    sides = {side: OpenArmFollowerConfigBase(port="can0", side=side) for side in ("left", "right")}
    inner = BiOpenArmFollowerConfig(
        left_arm_config=sides["left"], right_arm_config=sides["right"], calibration_dir=tmp_path
    )
    robot = make_robot_from_config(MimicIKEEConfig(arm=inner, calibration_dir=tmp_path))
    for side, (arm, _) in robot.sides.items():
        assert arm.description == describe_arm(f"openarm_{side}".removesuffix("_"))
        assert arm.units.unit == "deg"
    single = OpenArmFollowerConfig(port="can0", side="left", calibration_dir=tmp_path)
    robot = make_robot_from_config(MimicIKEEConfig(arm=single, calibration_dir=tmp_path))
    assert robot.sides[""][0].description == describe_arm("openarm_left")


def test_what_nobody_says_is_asked_for(tmp_path):
    sim = MimicIKSimConfig(arm="piper", calibration_dir=tmp_path)
    for options, reason in (
        ({"arm_description": FIVE}, "--robot.joints="),
        ({"joints": ["joint1"]}, "expected 6 of"),
        ({"arm_description": "no_arm"}, "no_arm"),
    ):
        with pytest.raises(ValueError, match=reason):
            make_robot_from_config(MimicIKEEConfig(arm=sim, calibration_dir=tmp_path, **options))
    with pytest.raises(ValueError, match="keys"):
        MimicIKEEConfig(arm=sim, keys="other")


@pytest.mark.parametrize("gripper", [float("nan"), float("inf")])
def test_a_gripper_that_is_no_number_stays(faced, gripper):
    robot = faced(MimicIKSimConfig(arm="piper", real_time=False, noise=0.0))
    seen = robot.get_observation()
    assert robot.send_action(seen | {"ee.gripper.pos": gripper})["ee.gripper.pos"] == seen["ee.gripper.pos"]
    press = {"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0}
    assert robot.send_action(press | {"gripper": gripper})["ee.gripper.pos"] == seen["ee.gripper.pos"]
    assert robot.send_action(press | {"gripper": 2.0})["ee.gripper.pos"] > seen["ee.gripper.pos"]


def test_a_unit_that_contradicts_the_robots_own_is_refused(faced):
    with pytest.raises(ValueError, match="mimicik_sim counts its joints in rad"):
        faced(MimicIKSimConfig(arm="piper", joint_units="rad", real_time=False), joint_units="deg")


def test_a_checkpoint_of_another_arm_is_refused_although_its_joints_have_the_same_names(faced):
    assert describe_arm("piper").joint_names == describe_arm("airbot_play").joint_names
    with pytest.raises(ValueError, match="checkpoint of another arm"):
        faced(MimicIKSimConfig(arm="piper", real_time=False), ik=IKOptions(path=str(SHIPPED / "airbot_play")))
