"""The arms that are shipped with the package: what their URDFs in `robots/` do not say.

A new arm is a new URDF and one entry here.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ShippedArm:
    """One shipped arm.

    Attributes:
        name: That `describe_arm` knows, and the name of its URDF.
        title: The product.
        base_link: The link whose frame poses are given in.
        tip_link: The link that carries the tool.
        home: A comfortable configuration to work from [rad], base to tip.
        rest: A configuration in which the arm may lose its power [rad], base to tip.
        robot_types: Types under which LeRobot and its plugins register robots with this arm.
        side: `left` or `right` where the two arms of a pair differ, else empty.
    """

    name: str
    title: str
    base_link: str
    tip_link: str
    home: tuple[float, ...]
    rest: tuple[float, ...]
    robot_types: tuple[str, ...] = ()
    side: str = ""


_RIGHT_ANGLE = 1.5708

_ARMS = (
    ShippedArm(
        "airbot_play",
        "AIRBOT Play",
        "base_link",
        "end_link",
        # Wrist bent by 1 rad, elbow near a right angle, tool half a metre ahead and level.
        home=(0.0, -1.2, 1.3, _RIGHT_ANGLE, -0.9, -_RIGHT_ANGLE),
        rest=(0.0,) * 6,
        robot_types=("airbot_play_can", "bi_airbot_play_can", "airbot_play", "bi_airbot_play"),
    ),
    ShippedArm(
        "piper",
        "AgileX Piper",
        "base_link",
        "link6",
        home=(0.0, 1.3, -1.2, 0.0, 0.8, 0.0),
        # Folded.
        rest=(0.0,) * 6,
        # lerobot-robot-wego-piper, lerobot-robot-piper and LeRobot's forks.
        robot_types=("piper_follower", "lerobot_robot_piper", "piper", "bi_piper_follower"),
    ),
    ShippedArm(
        "so101",
        "SO-101",
        "base_link",
        "gripper_frame_link",
        # Upper arm leaning back, tool 0.1 m above the table and 50 degrees down.
        home=(0.0, -0.6, 0.6, 0.9, 0.0),
        # Folded.
        rest=(0.0, -1.7, 1.55, 0.9, 0.0),
        robot_types=("so101_follower", "bi_so_follower"),
    ),
    ShippedArm(
        "so100",
        "SO-100",
        "base_link",
        "gripper_frame_link",
        home=(0.0, -0.6, 0.6, 0.9, 0.0),
        rest=(0.0, -1.7, 1.55, 0.9, 0.0),
        robot_types=("so100_follower",),
    ),
    ShippedArm(
        "openarm_right",
        "OpenArm 1.0, right",
        "body_link",
        "hand_tcp",
        # Elbow at a right angle, forearm level and ahead.
        home=(0.0, 0.2, 0.0, _RIGHT_ANGLE, 0.0, 0.0, 0.0),
        # Hanging.
        rest=(0.0,) * 7,
        robot_types=("openarm_follower", "bi_openarm_follower"),
        side="right",
    ),
    ShippedArm(
        "openarm_left",
        "OpenArm 1.0, left",
        "body_link",
        "hand_tcp",
        home=(0.0, -0.2, 0.0, _RIGHT_ANGLE, 0.0, 0.0, 0.0),
        rest=(0.0,) * 7,
        robot_types=("openarm_follower", "bi_openarm_follower"),
        side="left",
    ),
    ShippedArm(
        "yam",
        "I2RT YAM",
        "base_link",
        "grasp",
        # The home of MuJoCo Menagerie's model: tool level and ahead.
        home=(0.0, 1.047, 1.047, 0.0, 0.0, 0.0),
        # Folded.
        rest=(0.0,) * 6,
        # lerobot-robot-yam.
        robot_types=("yam_follower", "bimanual_yam_follower"),
    ),
    ShippedArm(
        "panda",
        "Franka Emika Panda",
        "panda_link0",
        "panda_hand_tcp",
        # The pose that the manufacturer's examples begin in: tool down.
        home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
        # Its brakes hold it anywhere.
        rest=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    ),
    ShippedArm(
        "fr3",
        "Franka Research 3",
        "fr3_link0",
        "fr3_hand_tcp",
        home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
        rest=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
    ),
    ShippedArm(
        "ur5e",
        "Universal Robots UR5e",
        "base_link",
        "tool0",
        # Elbow at a right angle, tool down.
        home=(0.0, -_RIGHT_ANGLE, _RIGHT_ANGLE, -_RIGHT_ANGLE, -_RIGHT_ANGLE, 0.0),
        # Its brakes hold it anywhere; upright is its own home.
        rest=(0.0, -_RIGHT_ANGLE, 0.0, -_RIGHT_ANGLE, 0.0, 0.0),
    ),
    ShippedArm(
        "xarm6",
        "UFACTORY xArm 6",
        "link_base",
        "link_eef",
        # Tool down.
        home=(0.0, -0.5, -0.8, 0.0, 1.3, 0.0),
        # Its brakes hold it anywhere; zero is its own home.
        rest=(0.0,) * 6,
        # lerobot-robot-xarm.
        robot_types=("lerobot_robot_xarm",),
    ),
)

SHIPPED: dict[str, ShippedArm] = {arm.name: arm for arm in _ARMS}
"""Every shipped arm by its name."""


def arm_of_robot_type(robot_type: str, side: str | None = None) -> str | None:
    """The shipped arm that robots of a LeRobot type have; None where none is known.

    Args:
        robot_type: As in `--robot.type`.
        side: `left` or `right`, for types whose arms come in pairs that differ; None: the right one.
    """
    fitting = [arm for arm in _ARMS if robot_type in arm.robot_types and arm.side in ("", side or "right")]
    return fitting[0].name if fitting else None
