"""LeRobot's phone teleoperation with MimicIK in place of its inverse kinematics: one import is another.

The steps are those of LeRobot's example `phone_to_so100`, for an arm with joints in degrees; a list of poses takes the
place of the phone. LeRobot's own `InverseKinematicsEEToJoints` runs with these kinematics as well; `MimicIKEEToJoints`
besides bounds each step and says what became of the pose. Run it with `uv run python examples/phone_pipeline.py`.
"""

from __future__ import annotations

import numpy as np
from lerobot.processor import RobotProcessorPipeline
from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action
from lerobot.robots.so_follower.robot_kinematic_processor import (
    EEBoundsAndSafety,
    EEReferenceAndDelta,
    GripperVelocityToJoint,
)
from lerobot.teleoperators.phone.config_phone import PhoneOS
from lerobot.teleoperators.phone.phone_processor import MapPhoneActionToRobotAction
from lerobot.utils.rotation import Rotation

from robot_adapters.adapter import IKStatus
from robot_adapters.kinematics import MimicIKKinematics
from robot_adapters.processor_steps import MimicIKEEToJoints


def make_pipeline(kinematics: MimicIKKinematics) -> RobotProcessorPipeline:
    """From a phone's pose and the robot's observation to the robot's action."""
    motors = [*kinematics.joint_names, "gripper"]
    return RobotProcessorPipeline(
        steps=[
            MapPhoneActionToRobotAction(platform=PhoneOS.IOS),
            EEReferenceAndDelta(
                kinematics=kinematics,
                end_effector_step_sizes={"x": 0.5, "y": 0.5, "z": 0.5},
                motor_names=motors,
            ),
            EEBoundsAndSafety(
                end_effector_bounds={"min": [-1.0, -1.0, -1.0], "max": [1.0, 1.0, 1.0]}, max_ee_step_m=0.10
            ),
            GripperVelocityToJoint(speed_factor=0.02, clip_max=0.07),
            MimicIKEEToJoints(kinematics=kinematics, motor_names=motors),  # was InverseKinematicsEEToJoints
        ],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )


def main(frames: int = 20) -> list[IKStatus]:
    """Move the phone 10 cm up; what became of each pose."""
    kinematics = MimicIKKinematics(
        "airbot_play"
    )  # was RobotKinematics(urdf_path, target_frame_name, joint_names)
    pipeline = make_pipeline(kinematics)
    step = pipeline.steps[-1]
    home = np.degrees(kinematics.description.home)
    joints = {f"{name}.pos": q for name, q in zip(kinematics.joint_names, home, strict=True)}
    observation = {**joints, "gripper.pos": 0.03}
    statuses = []
    for height in np.linspace(0.0, 0.1, frames):
        phone = {
            "phone.enabled": True,
            "phone.pos": np.array([0.0, 0.0, height]),
            "phone.rot": Rotation.from_rotvec([0.0, 0.0, 0.0]),
            "phone.raw_inputs": {"a3": 0.0},
        }
        action = pipeline((phone, observation))
        observation = {key: float(action[key]) for key in observation}  # a robot would move here
        statuses.append(step.result.status)
    print(f"{step.result.status}, {step.result.position_error * 1e3:.3f} mm off, joints in degrees:")
    print({key: round(value, 3) for key, value in observation.items()})
    return statuses


if __name__ == "__main__":
    main()
