"""Configuration of the end-effector face around any LeRobot robot."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import draccus
from lerobot.robots.config import RobotConfig

from lerobot_mimicik.configuration_reasons import reasons_for_users
from lerobot_mimicik.kinematics.poses import PoseFormat
from robot_adapters.ik_options import IKOptions
from robot_adapters.robots.config_airbot_play import check_end_effector
from robot_adapters.robots.units import check_unit


class JointRobot:
    """The robots that can be inside: every registered one but those in end-effector space.

    draccus asks a class for its choices when it builds the command line. A field of type `RobotConfig` would offer this
    configuration as a choice inside itself, without end; this class offers the others, as they are by then.
    """

    id: str | None

    @classmethod
    def get_known_choices(cls) -> dict[str, Any]:
        """Configurations by their type."""
        return {
            name: each
            for name, each in RobotConfig.get_known_choices().items()
            if "ik" not in {entry.name for entry in fields(each)}
        }

    @classmethod
    def get_choice_class(cls, name: str) -> Any:
        """The configuration of a type; KeyError for one that does not exist or is in end-effector space."""
        config = cls.get_known_choices()[name]
        return config if len(types_of(config)) == 1 else _of_type(config, name)

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """The type of a configuration; ValueError for what is none."""
        registry: Any = subcls if issubclass(subcls, RobotConfig) else RobotConfig
        return registry.get_choice_name(subcls)

    @classmethod
    def default_choice_name(cls) -> str | None:
        """None: it must be said which."""
        return None


def types_of(config: type) -> list[str]:
    """All types that a configuration is registered under: LeRobot's SO-100 and SO-101 are one class."""
    return [name for name, each in RobotConfig.get_known_choices().items() if each is config]


@functools.cache
def _of_type(config: type, name: str) -> type:
    """The same configuration, that remembers which of its types was asked for."""
    body = {"get_choice_name": classmethod(lambda cls, subcls: name), "__module__": config.__module__}
    return type(config.__name__, (config,), body)


@dataclass
class _Inside:
    robot: JointRobot


def parse_joint_robot(options: Sequence[str], prog: str) -> RobotConfig:
    """The robot in joint space that options such as `--robot.type=so101_follower --robot.port=...` describe.

    Raises:
        draccus.utils.DraccusException: A value that is none; SystemExit for an option that does not exist.
    """
    robot: Any = draccus.parse(_Inside, args=list(options), prog=prog).robot
    return robot


@RobotConfig.register_subclass("mimicik_ee")
@dataclass
class MimicIKEEConfig(RobotConfig):
    """Any LeRobot robot with joint positions, in end-effector space; two arms have the keys left_... and right_...."""

    # The robot inside: --robot.arm.type=so101_follower --robot.arm.port=...
    arm: JointRobot = None  # type: ignore[assignment]
    # A shipped arm's name or a URDF; empty: known by the inner robot's type.
    arm_description: str = ""
    # The inner robot's joints in the description's order, without .pos; empty: found by their names.
    joints: list[str] = field(default_factory=list)
    # Units of the inner robot's joints: deg, rad, normalised; auto: as the robot says.
    joint_units: str = "auto"
    # Leave out the gripper.
    gripper: bool = True
    # Spelling of the features: pos (ee.x.pos, which every command of LeRobot takes), lerobot (ee.x ... ee.wz,
    # ee.gripper_pos, as LeRobot's steps write them) or delta (what its keyboard and gamepad send, to record them).
    keys: str = "pos"
    # Format of the pose: quaternion (ee.qx.pos ...), rotation_vector (ee.wx.pos ...) or rotation_6d.
    rotation: str = "quaternion"
    # Pose of the robot's tool in the arm's tool frame: x y z qx qy qz qw; empty: the same.
    tool: list[float] = field(default_factory=list)
    # What a keyboard's or gamepad's 1 moves the target by in a frame [m].
    delta_step: float = 0.002
    # Positions of the gripper when closed and when open, in the robot's unit, for keyboard and gamepad.
    gripper_range: list[float] = field(default_factory=lambda: [0.0, 100.0])
    ik: IKOptions = field(default_factory=IKOptions)

    def __post_init__(self) -> None:
        with reasons_for_users():
            if self.arm is None:
                choices = ", ".join(sorted(JointRobot.get_known_choices()))
                raise ValueError(f"which robot is inside? --robot.arm.type=... says it: one of {choices}")
            if not isinstance(self.arm, RobotConfig):
                raise ValueError(f"arm: expected the configuration of a robot, got {self.arm!r}")
            if self.keys not in ("pos", "lerobot", "delta"):
                raise ValueError(f"keys={self.keys!r}: expected pos, lerobot or delta")
            if self.joint_units != "auto":
                check_unit(self.joint_units)
            if not 0 < self.delta_step <= 0.02:
                raise ValueError(f"delta_step={self.delta_step}: expected more than 0, at most 0.02 m")
            if len(self.gripper_range) != 2:
                raise ValueError(f"gripper_range={self.gripper_range}: expected two numbers, closed and open")
            super().__post_init__()
        check_end_effector(self.ik, self.rotation, self.tool)

    @property
    def form(self) -> PoseFormat:
        """Format of the poses: LeRobot's own spelling has rotation vectors."""
        return PoseFormat.ROTATION_VECTOR if self.keys == "lerobot" else PoseFormat(self.rotation)
