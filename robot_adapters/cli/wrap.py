"""`mimicik wrap`: an end-effector policy's checkpoint made ready for a robot, in joint or end-effector space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_mimicik.cli.options import parse
from robot_adapters.ik_options import IKOptions

HELP = "Put a MimicIK checkpoint into an end-effector policy's, so that it drives robots in joint space."


@dataclass
class PolicyPath:
    """The end-effector policy."""

    # Its checkpoint: a folder, a training run's output folder, or a Hub repository.
    path: str = ""


@dataclass
class WrapConfig:
    """Options of `mimicik wrap`.

    Without --ik.path the robot takes poses (airbot_play_ee), and a policy without cameras is only given its state
    as environment state, as LeRobot's policies want it and robots do not give it.

    Example: `mimicik wrap --policy.path=POLICY --ik.path=outputs/demo/train --output=outputs/wrapped`
    """

    policy: PolicyPath = field(default_factory=PolicyPath)
    ik: IKOptions = field(default_factory=IKOptions)
    # Folder of the checkpoint to write; use it as --policy.path of lerobot-rollout.
    output: str = ""
    # Format of the policy's poses: quaternion, rotation_vector, rotation_6d, rotation_6d_rows.
    rotation: str = "quaternion"
    # The policy's tool in the arm's tool frame: x y z qx qy qz qw; empty: the same.
    tool: list[float] = field(default_factory=list)
    # Units of the robot's joints: rad or deg.
    joint_units: str = "rad"


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    config = parse(WrapConfig, argv, "mimicik wrap")
    for option, value in (
        ("policy.path", config.policy.path),
        ("output", config.output),
    ):
        if not value:
            raise ValueError(f"--{option} is missing")
    from lerobot_mimicik.checkpoints import check_device, find_checkpoint

    for path in filter(None, (config.policy.path, config.ik.path)):
        find_checkpoint(path)
    check_device(config.ik.device)
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_mimicik.kinematics.poses import PoseFormat
    from robot_adapters.wrapping import wrap_checkpoint

    register_third_party_plugins()
    folder = wrap_checkpoint(
        config.policy.path,
        config.ik.path or None,
        config.output,
        rotation=PoseFormat(config.rotation),
        tool=config.tool,
        joint_units=config.joint_units,
        settings=config.ik.settings(),
    )
    space = "joints" if config.ik.path else "poses"
    print(f"{folder}: takes and gives {space}; run it with lerobot-rollout --policy.path={folder}")
    return 0
