"""Kept for users: `lerobot_mimicik.kinematics.poses` under the name that it was first published as."""

from lerobot_mimicik.guidance.approach import towards
from lerobot_mimicik.kinematics.poses import (
    PolicyFrames,
    PoseFormat,
    PoseReference,
    compose,
    decode_pose,
    encode_pose,
    inverse,
    pose_distance,
)

__all__ = [
    "PolicyFrames",
    "PoseFormat",
    "PoseReference",
    "compose",
    "decode_pose",
    "encode_pose",
    "inverse",
    "pose_distance",
    "towards",
]
