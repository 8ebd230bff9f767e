"""The place of LeRobot's RobotKinematics: its methods, and LeRobot's own steps with these kinematics on a simulated arm."""

import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
from lerobot.processor import RobotProcessorPipeline
from lerobot.processor.converters import (
    observation_to_transition,
    robot_action_observation_to_transition,
    transition_to_observation,
    transition_to_robot_action,
)
from lerobot.robots.so_follower.robot_kinematic_processor import (
    EEBoundsAndSafety,
    EEReferenceAndDelta,
    ForwardKinematicsJointsToEE,
    GripperVelocityToJoint,
    InverseKinematicsEEToJoints,
)
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.phone.config_phone import PhoneOS
from lerobot.teleoperators.phone.phone_processor import MapPhoneActionToRobotAction
from lerobot.utils.rotation import Rotation

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from robot_adapters.adapter import IKStatus
from robot_adapters.kinematics import MimicIKKinematics as RobotKinematics  # the line that is another
from robot_adapters.processor_steps import MimicIKEEToJoints
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig


@pytest.fixture
def arm(tmp_path):
    """A simulated arm in degrees, connected."""

    def connect(name):
        robot = make_robot_from_config(
            MimicIKSimConfig(arm=name, real_time=False, fps=20, calibration_dir=tmp_path)
        )
        robot.connect()
        return robot

    return connect


def home(kinematics) -> np.ndarray:
    return np.degrees(kinematics.description.home)


def test_there_and_back_in_degrees_and_matrices(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(describe_arm("piper").urdf)
    kinematics = RobotKinematics(str(urdf), "link6", [f"joint{i}" for i in (6, 5, 4, 3, 2, 1)] + ["gripper"])
    q = np.array([*home(RobotKinematics("piper"))[::-1], 42.0])
    pose = kinematics.forward_kinematics(q)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(RobotKinematics("piper").forward_kinematics(q[5::-1]), pose)
    target = pose.copy()
    target[2, 3] += 0.1  # where LeRobot's own call is said to leave 29 mm
    answer = kinematics.inverse_kinematics(q, target)
    assert answer[-1] == 42.0
    np.testing.assert_allclose(kinematics.forward_kinematics(answer), target, atol=1e-4)
    assert kinematics.result.status is IKStatus.REACHED
    np.testing.assert_allclose(q[:-1], home(RobotKinematics("piper"))[::-1])  # the caller's own


def test_without_orientation_only_the_position_counts():
    kinematics = RobotKinematics("airbot_play")
    q = home(kinematics)
    target = kinematics.forward_kinematics(q)
    target[:3, :3] = Rotation.from_rotvec([2.0, 0.0, 0.0]).as_matrix() @ target[:3, :3]
    target[0, 3] -= 0.05
    answer = kinematics.inverse_kinematics(q, target, orientation_weight=0.0)
    np.testing.assert_allclose(kinematics.forward_kinematics(answer)[:3, 3], target[:3, 3], atol=1e-4)
    assert np.abs(answer - q).max() < 30


def test_errors_name_the_thing():
    with pytest.raises(ValueError, match="joint6"):
        RobotKinematics("piper", joint_names=["joint1", "joint2"])
    with pytest.raises(ValueError, match="no_arm"):
        RobotKinematics("no_arm")
    kinematics = RobotKinematics("piper")
    with pytest.raises(ValueError, match=r"\(2,\)"):
        kinematics.forward_kinematics([0.0, 0.0])
    with pytest.raises(ValueError, match="4x4"):
        kinematics.inverse_kinematics(home(kinematics), np.eye(3))


def phone_pipeline(kinematics, motors, step):
    """The steps of LeRobot's example phone_to_so100."""
    return RobotProcessorPipeline(
        steps=[
            MapPhoneActionToRobotAction(platform=PhoneOS.IOS),
            EEReferenceAndDelta(
                kinematics=kinematics,
                end_effector_step_sizes={"x": 0.5, "y": 0.5, "z": 0.5},
                motor_names=motors,
                use_latched_reference=True,
            ),
            EEBoundsAndSafety(end_effector_bounds={"min": [-1.0] * 3, "max": [1.0] * 3}, max_ee_step_m=0.10),
            GripperVelocityToJoint(speed_factor=20.0),
            step,
        ],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )


@pytest.mark.parametrize("name", SHIPPED_ARMS)
@pytest.mark.parametrize("ours", [False, True])
def test_lerobots_phone_example_moves_a_simulated_arm(arm, name, ours):
    robot = arm(name)
    kinematics = RobotKinematics(name, joint_names=[*robot.description.joint_names, "gripper"])
    motors = [key.removesuffix(".pos") for key in robot.action_features]
    kind = MimicIKEEToJoints if ours else InverseKinematicsEEToJoints
    step = kind(kinematics=kinematics, motor_names=motors, initial_guess_current_joints=False)
    pipeline = phone_pipeline(kinematics, motors, step)
    start = robot.get_observation()
    rest = kinematics.forward_kinematics([start[f"{each}.pos"] for each in motors])[:3, 3]
    for frame in range(60):
        # Held, moved up, let go, and held again, where LeRobot's phone counts from zero: the arm stays.
        enabled = frame < 30 or frame >= 40
        height = min(frame, 20) * 0.005 if frame < 40 else 0.0
        phone = {
            "phone.enabled": enabled,
            "phone.pos": np.array([0.0, 0.0, height]),
            "phone.rot": Rotation.from_rotvec([0.0, 0.0, 0.0]),
            "phone.raw_inputs": {"a3": 0.0},
        }
        action = pipeline((phone, robot.get_observation()))
        before = robot.servos.target
        robot.send_action(action)
        assert np.abs(robot.servos.target - before).max() <= (0.0951 if ours else 0.77)
        if frame == 29:
            end = robot.get_observation()
            moved = kinematics.forward_kinematics([end[f"{each}.pos"] for each in motors])[:3, 3] - rest
            np.testing.assert_allclose(moved, [0.0, 0.0, 0.05], atol=0.012)


def test_lerobots_ee_recording_and_replay_examples(arm):
    robot = arm("airbot_play")
    motors = [key.removesuffix(".pos") for key in robot.action_features]
    kinematics = RobotKinematics("airbot_play", joint_names=motors)
    to_ee = RobotProcessorPipeline(
        steps=[ForwardKinematicsJointsToEE(kinematics=kinematics, motor_names=motors)],
        to_transition=observation_to_transition,
        to_output=transition_to_observation,
    )
    to_joints = RobotProcessorPipeline(
        steps=[
            InverseKinematicsEEToJoints(
                kinematics=kinematics, motor_names=motors, initial_guess_current_joints=False
            )
        ],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    start = robot.get_observation()
    leader = [
        start | {"joint1.pos": start["joint1.pos"] + turn, "joint3.pos": start["joint3.pos"] + turn / 2}
        for turn in range(15)
    ]
    recorded = [to_ee(dict(joints)) for joints in leader]
    assert set(recorded[0]) == {f"ee.{name}" for name in ("x", "y", "z", "wx", "wy", "wz", "gripper_pos")}
    for pose, joints in zip(recorded, leader, strict=True):
        action = to_joints((dict(pose), robot.get_observation()))
        robot.send_action(action)
        np.testing.assert_allclose(
            [action[key] for key in robot.joint_keys], [joints[key] for key in robot.joint_keys], atol=0.2
        )
