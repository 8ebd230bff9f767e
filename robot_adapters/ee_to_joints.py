"""MimicIKEEToJoints: a step of a robot's pipeline, where LeRobot has `InverseKinematicsEEToJoints`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotAction, TransitionKey
from lerobot.processor import RobotActionProcessorStep

from lerobot_mimicik.kinematics.poses import PolicyFrames, PoseFormat
from robot_adapters.adapter import IKResult, MimicIKAdapter
from robot_adapters.joint_units import check_joints, check_rad_or_deg, to_rad
from robot_adapters.kinematics import MimicIKKinematics

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
_POSE = ("x", "y", "z", "wx", "wy", "wz")
_LONGEST_TURN = 4 * np.pi
"""rad: no rotation needs a vector longer than half a turn, sums of small turns reach some; degrees exceed it."""


@dataclass
class MimicIKEEToJoints(RobotActionProcessorStep):
    """`ee.x .. ee.wz` (position in m, rotation vector in rad) and `ee.gripper_pos` to `<joint>.pos`.

    The contract of `InverseKinematicsEEToJoints`, and its keywords, but: joints are taken by name, in any order; the
    gripper may have any name, or be absent; joints are in radians or degrees; and `result` says what became of the pose.

    Attributes:
        adapter: The arm's inverse kinematics.
        motor_names: The robot's motors, in its order; those that are not the arm's joints pass through (one
            gripper at most).
        joint_units: `rad` or `deg`, of the robot; it has no default but with `MimicIKKinematics`, which counts in
            degrees.
        kinematics: In place of `adapter`: the same, or the arm's `MimicIKKinematics`.
        initial_guess_current_joints: LeRobot's keyword for the joints that a step starts from: True sets the
            adapter's `reference` to `measured`, False to `commanded`; None leaves it.
        orientation_weight: LeRobot's keyword; 0 leaves the orientation free, with `MimicIKKinematics` alone.
        result: What became of the last pose; None before.
    """

    adapter: MimicIKAdapter = None  # type: ignore[assignment]
    motor_names: list[str] = field(default_factory=list)
    joint_units: str = ""
    kinematics: MimicIKAdapter | MimicIKKinematics | None = None
    initial_guess_current_joints: bool | None = None
    orientation_weight: float = 0.01
    result: IKResult | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.kinematics, MimicIKKinematics):
            self.kinematics = self.kinematics.make_adapter(self.orientation_weight)
            self.joint_units = self.joint_units or "deg"
        given = [each for each in (self.adapter, self.kinematics) if each is not None]
        if len(given) != 1 or not isinstance(given[0], MimicIKAdapter):
            found = " and ".join(type(each).__name__ for each in given) or "none"
            raise TypeError(
                f"expected one MimicIKAdapter as adapter (or kinematics), got {found}; "
                "MimicIKAdapter.from_pretrained(checkpoint) or MimicIKAdapter.for_arm(arm) makes one, "
                "robot_adapters.kinematics.MimicIKKinematics(urdf) does as well, and placo is not needed"
            )
        self.adapter = self.kinematics = given[0]
        if self.initial_guess_current_joints is not None:
            reference = "measured" if self.initial_guess_current_joints else "commanded"
            self.adapter.settings = replace(self.adapter.settings, reference=reference)
        missing = [name for name in self.adapter.joint_names if name not in self.motor_names]
        others = [name for name in self.motor_names if name not in self.adapter.joint_names]
        if missing or len(others) > 1:
            raise ValueError(
                f"the checkpoint drives {list(self.adapter.joint_names)}; motor_names {self.motor_names} lack "
                f"{missing} and have {others} besides (expected one gripper at most)"
            )
        check_rad_or_deg(self.joint_units)
        self._gripper = others[0] if others else None

    def action(self, action: RobotAction) -> RobotAction:
        """Replaces the pose by joints.

        Raises:
            KeyError: A number of the pose, or a joint of the observation, is missing.
            ValueError: Joints or a rotation that are in another unit, as far as that can be seen.
        """
        keys = [f"ee.{name}" for name in _POSE] + (["ee.gripper_pos"] if self._gripper else [])
        missing = [key for key in keys if action.get(key) is None]
        if missing:
            raise KeyError(f"the action lacks {missing}; it has {sorted(action)}")
        observation = self.transition.get(TransitionKey.OBSERVATION) or {}
        joints = [f"{name}.pos" for name in self.adapter.joint_names]
        if any(key not in observation for key in joints):
            raise KeyError(
                f"the observation has {sorted(observation)}; expected the measured joints {joints}"
            )
        turn = to_rad(self.joint_units)
        measured = np.array([float(observation[key]) for key in joints]) * turn
        check_joints(self.adapter.description, measured, self.joint_units)
        numbers = [float(action.pop(key)) for key in keys]
        if np.linalg.norm(numbers[3:6]) > _LONGEST_TURN:
            raise ValueError(f"ee.wx, ee.wy, ee.wz are {numbers[3:6]}: expected a rotation vector in rad")
        frames = PolicyFrames(form=PoseFormat.ROTATION_VECTOR)
        target = frames.from_policy(numbers[:6], self.adapter.forward(measured))
        self.result = self.adapter.solve(measured, target)
        q = self.result.q / turn
        for name in self.motor_names:
            if name == self._gripper:
                action[f"{name}.pos"] = numbers[6]
            else:
                action[f"{name}.pos"] = float(q[self.adapter.joint_names.index(name)])
        return action

    def transform_features(self, features: Features) -> Features:
        """Pose features out, joint features in."""
        for name in (*_POSE, "gripper_pos"):
            features[PipelineFeatureType.ACTION].pop(f"ee.{name}", None)
        for name in self.motor_names:
            features[PipelineFeatureType.ACTION][f"{name}.pos"] = PolicyFeature(FeatureType.ACTION, (1,))
        return features

    def reset(self) -> None:
        """Forget the past."""
        self.adapter.reset()
        self.result = None
