"""Configurations of the AIRBOT Play as LeRobot robots."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig

from lerobot_mimicik.configuration_reasons import reasons_for_users
from lerobot_mimicik.kinematics.poses import PolicyFrames, PoseFormat
from robot_adapters.ik_options import IKOptions


@dataclass
class AirbotConnection:
    """One arm's bus, and how it is driven."""

    # python-can's interface: socketcan, slcan, udp_multicast; virtual starts a simulated arm by itself.
    interface: str = "socketcan"
    # can0, /dev/ttyACM0, a multicast address; null: the interface's usual one.
    channel: str | None = None
    # Units of the joints' features: rad or deg.
    joint_units: str = "rad"
    # Targets further away are walked to in steps of this size [rad]; null: they are refused beyond 0.5 rad.
    max_relative_target: float | None = None
    # Leave out the gripper, for an arm without one.
    gripper: bool = True
    # interface=virtual: joints at which the simulated arm starts [rad]; empty: its home.
    start: list[float] = field(default_factory=list)
    # interface=virtual: false lets the simulated arm wait for a computer that is too slow for real time.
    real_time: bool = True

    def __post_init__(self) -> None:
        with reasons_for_users():
            if self.joint_units not in ("rad", "deg"):
                raise ValueError(f"joint_units={self.joint_units!r}: expected 'rad' or 'deg'")
            if self.max_relative_target is not None and not 0 < self.max_relative_target <= 0.5:
                raise ValueError(
                    f"max_relative_target={self.max_relative_target}: expected more than 0, at most 0.5 rad"
                )


@RobotConfig.register_subclass("airbot_play_can")
@dataclass
class AirbotPlayConfig(AirbotConnection, RobotConfig):
    """An AIRBOT Play in joint space: joint1.pos ... joint6.pos, gripper.pos (opening in m)."""

    cameras: dict[str, CameraConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        AirbotConnection.__post_init__(self)
        with reasons_for_users():
            RobotConfig.__post_init__(self)


@RobotConfig.register_subclass("airbot_play_can_ee")
@dataclass
class AirbotPlayEEConfig(AirbotPlayConfig):
    """An AIRBOT Play in end-effector space: ee.x.pos ... ee.gripper.pos, with MimicIK inside.

    `max_relative_target` is not used: the adapter approaches far targets step by step.
    """

    ik: IKOptions = field(default_factory=IKOptions)
    # Format of the pose: quaternion (ee.qx.pos ...), rotation_vector (ee.wx.pos ...) or rotation_6d.
    rotation: str = "quaternion"
    # Pose of the robot's tool in the checkpoint's tool frame: x y z qx qy qz qw; empty: the same.
    tool: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_end_effector(self.ik, self.rotation, self.tool)


@dataclass
class BiAirbotOptions:
    """Two arms side by side, each on a bus of its own; the keys of each begin with left_ and right_."""

    left: AirbotConnection = field(default_factory=AirbotConnection)
    right: AirbotConnection = field(default_factory=lambda: AirbotConnection(channel="can1"))


@RobotConfig.register_subclass("bi_airbot_play_can")
@dataclass
class BiAirbotPlayConfig(BiAirbotOptions, RobotConfig):
    """Two AIRBOT Plays in joint space."""

    cameras: dict[str, CameraConfig] = field(default_factory=dict)


@RobotConfig.register_subclass("bi_airbot_play_can_ee")
@dataclass
class BiAirbotPlayEEConfig(BiAirbotPlayConfig):
    """Two AIRBOT Plays in end-effector space, each pose in its own arm's base frame."""

    ik: IKOptions = field(default_factory=IKOptions)
    rotation: str = "quaternion"
    tool: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_end_effector(self.ik, self.rotation, self.tool)


def check_end_effector(ik: IKOptions, rotation: str, tool: list[float]) -> None:
    """Refuse options of an end effector that cannot be; ValueError, DecodingError where LeRobot parses."""
    with reasons_for_users():
        ik.settings()
        try:
            PoseFormat(rotation)
        except ValueError as error:
            raise ValueError(f"rotation={rotation!r}: {error}") from error
        if tool:
            try:
                PolicyFrames(tool=tool)
            except ValueError as error:
                raise ValueError(f"tool={tool}: {error}") from error
