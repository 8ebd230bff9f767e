"""LeRobot's phone and end-effector examples, their loops and steps, on a simulated SO-101: one import is another."""

from dataclasses import dataclass

import lerobot_policy_mimicik  # noqa: F401 - registers the robots, as LeRobot's commands do
import numpy as np
import pytest
import torch
from lerobot.common.control_utils import predict_action
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset, aggregate_pipeline_dataset_features, create_initial_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.utils import make_robot_action
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
from lerobot.scripts.lerobot_record import record_loop
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.phone.config_phone import PhoneOS
from lerobot.teleoperators.phone.phone_processor import MapPhoneActionToRobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.feature_utils import build_dataset_frame, combine_feature_dicts
from lerobot.utils.rotation import Rotation

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import PoseFormat
from robot_adapters.kinematics import MimicIKKinematics as RobotKinematics  # the line that is another
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig
from robot_adapters.wrapping import wrap_checkpoint

ARM = describe_arm("so101")
MOTORS = [*ARM.joint_names, "gripper"]
FPS = 30


@dataclass
class HandConfig(TeleoperatorConfig):
    """Of what holds the place of the hardware that leads."""


class Phone(Teleoperator):
    """A phone that is lifted by 8 cm."""

    config_class, name, is_calibrated, feedback_features = HandConfig, "phone", True, {}
    is_connected = True
    action_features = {  # noqa: RUF012
        "phone.pos": np.ndarray,
        "phone.rot": Rotation,
        "phone.raw_inputs": dict,
        "phone.enabled": bool,
    }
    frame = 0

    def __init__(self, config):
        super().__init__(config)
        self.events = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}

    def connect(self, calibrate=True):
        pass

    calibrate = configure = disconnect = connect

    def send_feedback(self, feedback):
        pass

    def count(self):
        """A second's frames, however long they take."""
        self.frame += 1
        self.events["exit_early"] = self.frame == FPS

    def get_action(self):
        self.count()
        return {
            "phone.pos": np.array([0.0, 0.0, 0.004 * min(self.frame, 20)]),
            "phone.rot": Rotation.from_rotvec([0.0, 0.0, 0.0]),
            "phone.raw_inputs": {"a3": 0.0},
            "phone.enabled": True,
        }


class Leader(Phone):
    """A leader arm that swings about home."""

    name = "leader"
    action_features = dict.fromkeys([f"{name}.pos" for name in MOTORS], float)

    def get_action(self):
        self.count()
        q = np.degrees(ARM.home) + 10 * np.sin(self.frame / FPS) * np.array([1.0, 0.5, 0.5, 0.3, 0.5])
        return dict(zip(self.action_features, [*q, 40.0], strict=True))


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    """As the examples make it: from a URDF's file, with the robot's motors, gripper included."""
    urdf = tmp_path_factory.mktemp("SO101") / "so101_new_calib.urdf"
    urdf.write_text(ARM.urdf)
    return RobotKinematics(
        urdf_path=str(urdf), target_frame_name="gripper_frame_link", joint_names=list(MOTORS)
    )


@pytest.fixture
def arm(tmp_path):
    """A simulated SO-101 at home, in degrees."""

    def connect():
        config = MimicIKSimConfig(arm="so101", real_time=False, fps=FPS, calibration_dir=tmp_path)
        robot = make_robot_from_config(config)
        robot.connect()
        return robot

    return connect


def to_ee(kinematics):
    """Measured joints to poses."""
    return RobotProcessorPipeline(
        steps=[ForwardKinematicsJointsToEE(kinematics=kinematics, motor_names=MOTORS)],
        to_transition=observation_to_transition,
        to_output=transition_to_observation,
    )


def to_joints(kinematics, measured=True, bounds=()):
    """Poses to the robot's joints."""
    inverse = InverseKinematicsEEToJoints(
        kinematics=kinematics, motor_names=MOTORS, initial_guess_current_joints=measured
    )
    return RobotProcessorPipeline(
        steps=[*bounds, inverse],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )


def led(hand, kinematics):
    """What the hand sends to poses, and poses to joints: `phone_to_so100` and `so100_to_so100_EE`."""

    def bounds(step):
        return EEBoundsAndSafety(
            end_effector_bounds={"min": [-1.0] * 3, "max": [1.0] * 3}, max_ee_step_m=step
        )

    if isinstance(hand, Leader):
        lead = RobotProcessorPipeline(
            steps=[ForwardKinematicsJointsToEE(kinematics=kinematics, motor_names=MOTORS)],
            to_transition=robot_action_observation_to_transition,
            to_output=transition_to_robot_action,
        )
        return lead, to_joints(kinematics, bounds=[bounds(0.10)])
    lead = RobotProcessorPipeline(
        steps=[
            MapPhoneActionToRobotAction(platform=PhoneOS.IOS),
            EEReferenceAndDelta(
                kinematics=kinematics,
                end_effector_step_sizes={"x": 0.5, "y": 0.5, "z": 0.5},
                motor_names=MOTORS,
                use_latched_reference=True,
            ),
            bounds(0.20),
            GripperVelocityToJoint(speed_factor=20.0),
        ],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    return lead, to_joints(kinematics)


def record(robot, hand, kinematics, root):
    """A second of the examples' `record.py`."""
    lead, follow = led(hand, kinematics)
    features = combine_feature_dicts(
        aggregate_pipeline_dataset_features(
            pipeline=lead,
            initial_features=create_initial_features(action=hand.action_features),
            use_videos=True,
        ),
        aggregate_pipeline_dataset_features(
            pipeline=to_ee(kinematics),
            initial_features=create_initial_features(observation=robot.observation_features),
            use_videos=True,
        ),
    )
    dataset = LeRobotDataset.create("local/ee", FPS, features=features, root=root, robot_type=robot.name)
    record_loop(
        robot=robot,
        events=hand.events,
        fps=FPS,
        teleop_action_processor=lead,
        robot_action_processor=follow,
        robot_observation_processor=to_ee(kinematics),
        teleop=hand,
        dataset=dataset,
        control_time_s=600,
        single_task="follow",
    )
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/ee", root=root)


@pytest.mark.parametrize("hand", [Phone, Leader])
def test_recorded_in_poses_then_replayed(hand, arm, kinematics, tmp_path):
    robot, again = arm(), arm()
    dataset = record(robot, hand(HandConfig(calibration_dir=tmp_path)), kinematics, tmp_path / "ee")
    names = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
    assert dataset.features["action"]["names"] == dataset.features["observation.state"]["names"] == names
    frames = dataset.hf_dataset.with_format("numpy")[:]
    assert np.ptp(frames["action"][:, :3], axis=0).max() > 0.01
    follow, taken = to_joints(kinematics, measured=False), []
    for pose in frames["action"]:
        joints = follow((dict(zip(names, pose.tolist(), strict=True)), again.get_observation()))
        again.send_action(joints)
        taken.append(kinematics.forward_kinematics([joints[f"{name}.pos"] for name in MOTORS])[:3, 3])
    np.testing.assert_allclose(taken, frames["action"][:, :3], atol=1e-4)
    np.testing.assert_allclose(
        again.servos.target, robot.servos.target, atol=0.02
    )  # and as when it was recorded


def test_a_policy_in_poses_drives_the_arm(arm, kinematics, tmp_path):
    dataset = record(arm(), Leader(HandConfig(calibration_dir=tmp_path)), kinematics, tmp_path / "ee")
    seven = PolicyFeature(FeatureType.STATE, (7,))
    config = ACTConfig(
        input_features={
            "observation.state": seven,
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (7,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        device="cpu",
        chunk_size=5,
        n_action_steps=5,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
    )
    ACTPolicy(config).save_pretrained(tmp_path / "act")
    for each in make_pre_post_processors(config, dataset_stats=dataset.meta.stats):
        each.save_pretrained(tmp_path / "act")
    # A policy without cameras wants an environment state.
    path = wrap_checkpoint(
        str(tmp_path / "act"), None, tmp_path / "wrapped", rotation=PoseFormat.ROTATION_VECTOR
    )
    policy = ACTPolicy.from_pretrained(path)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(path))
    robot, start, observe, follow = arm(), np.array(ARM.home), to_ee(kinematics), to_joints(kinematics)
    for _ in range(FPS):
        seen = robot.get_observation()
        poses = observe(dict(seen))
        action = predict_action(
            observation=build_dataset_frame(dataset.features, poses, prefix="observation"),
            policy=policy,
            device=torch.device("cpu"),
            preprocessor=before,
            postprocessor=after,
            use_amp=False,
            task="follow",
            robot_type=robot.name,
        )
        pose = make_robot_action(action, dataset.features)
        asked = [pose[f"ee.{axis}"] for axis in "xyz"]
        robot.send_action(follow((pose, seen)))
    sent = np.degrees(robot.servos.target)
    np.testing.assert_allclose(kinematics.forward_kinematics([*sent, 0.0])[:3, 3], asked, atol=1e-3)
    assert np.abs(robot.servos.target - start).max() > 1e-3
