"""Kinematics of a serial arm: URDF, forward kinematics, rotations and the FK consistency loss.

The descriptions (`describe_arm`, `read_urdf`) need neither torch nor pytorch_kinematics; the rest is imported
when it is first asked for, so that LeRobot's commands, which import every plugin's configuration, start
quickly.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, ArmDescription, describe_arm
from lerobot_mimicik.kinematics.urdf import Joint, Urdf, UrdfError, read_urdf

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.kinematics.fk_loss import fk_consistency_loss
    from lerobot_mimicik.kinematics.rotations import pose_error, relative_pose

__all__ = [
    "SHIPPED_ARMS",
    "ArmDescription",
    "Joint",
    "SerialArm",
    "Urdf",
    "UrdfError",
    "describe_arm",
    "fk_consistency_loss",
    "pose_error",
    "read_urdf",
    "relative_pose",
]

_LAZY = {
    "SerialArm": "chain",
    "fk_consistency_loss": "fk_loss",
    "pose_error": "rotations",
    "relative_pose": "rotations",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
