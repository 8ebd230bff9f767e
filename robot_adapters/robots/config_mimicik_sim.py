"""Configuration of any arm, simulated, as a LeRobot robot."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig

from lerobot_mimicik.configuration_reasons import reasons_for_users
from robot_adapters.robots.units import check_unit


@RobotConfig.register_subclass("mimicik_sim")
@dataclass
class MimicIKSimConfig(RobotConfig):
    """A shipped arm or a URDF on simulated servos, in joint space: NAME.pos of each joint, gripper.pos (0 to 100)."""

    # A shipped arm's name (mimicik arms lists them), or the path of a URDF.
    arm: str = "so101"
    # Where the chain of the URDF begins and ends; empty: the shipped arm's, else its root and only leaf.
    base_link: str = ""
    tip_link: str = ""
    # Units of the joints' features: deg, rad, or normalised (-100 to 100 over each joint's limits).
    joint_units: str = "deg"
    # Leave out the gripper, for an arm without one.
    gripper: bool = True
    # Joints at which it starts [rad]; empty: the arm's home.
    start: list[float] = field(default_factory=list)
    # Delay of the servos [s], how far they hang below their command at most [rad], and noise of the encoders [rad].
    lag: float = 0.06
    sag: float = 0.01
    noise: float = 3e-4
    # Of the noise.
    seed: int = 0
    # Its time is the computer's; false: 1 / fps passes with each action, however long the computer takes.
    real_time: bool = True
    # real_time=false: actions in a second of simulated time.
    fps: int = 30
    # Show the arm on a page in the browser (extra play), at this port or the next free one.
    view: bool = False
    view_port: int = 8080
    cameras: dict[str, CameraConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with reasons_for_users():
            super().__post_init__()
            check_unit(self.joint_units)
            if self.fps < 1:
                raise ValueError(f"fps={self.fps}: expected at least 1")
