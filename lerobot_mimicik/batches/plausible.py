"""Whether the frames of a training dataset can be of the arm that is trained for."""

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_mimicik.batches.frames import FrameReader
from lerobot_mimicik.batches.loading import FrameTable
from lerobot_mimicik.configuration_learned import LearnedIKConfig
from lerobot_mimicik.kinematics.recorded import Column, check_recorded

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def check_table(table: FrameTable, config: LearnedIKConfig, where: str) -> None:
    """Refuse frames with another unit, arm or order of quaternions than the configuration's.

    Args:
        table: Columns of the training episodes.
        config: Names the columns and their units.
        where: The dataset, for messages.

    Raises:
        ValueError: As `check_recorded`; it names the configuration's field that mends it.
    """
    reader = FrameReader(config)
    names = config.joint_names or []

    def joints(key: str, columns: list[int] | None) -> Column:
        return Column(key, reader.joints(table.columns[key], columns).numpy(), names)

    def pose(key: str | None) -> Column | None:
        values: Tensor | None = table.columns.get(key) if key is not None else None
        return None if key is None or values is None else Column(key, values[:, :7].numpy(), _POSE)

    degrees = "--policy.joint_units=deg reads the dataset in degrees, --policy.urdf=... names another arm."
    check_recorded(
        config.arm_description(),
        np.asarray(table.columns["episode_index"]),
        joints(OBS_STATE, config.state_joint_columns),
        joints(ACTION, config.action_joint_columns) if config.target == "action" else None,
        pose(config.current_pose_key),
        pose(config.target_pose_key) if config.target_pose_recorded else None,
        where=where,
        joints_remedy=degrees if config.joint_units == "rad" else "--policy.urdf=... names another arm.",
    )
