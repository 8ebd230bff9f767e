"""Whether a recording can be of an arm: finite numbers, joints within its limits, poses within its reach."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import (
    COMMANDS_OUTSIDE_LIMITS,
    why_not_joints,
    why_not_order,
    why_not_poses,
)


@dataclass(frozen=True, eq=False)
class Column:
    """Numbers of one dataset column.

    Attributes:
        name: The column's.
        values: Shape (N, d), joints in rad, poses as x y z [m] qx qy qz qw.
        elements: Names of the d numbers.
    """

    name: str
    values: NDArray[np.floating]
    elements: Sequence[str]


def check_recorded(
    description: ArmDescription,
    episode: NDArray[np.integer],
    joints: Column,
    commands: Column | None = None,
    current_pose: Column | None = None,
    target_pose: Column | None = None,
    *,
    where: str = "the dataset",
    joints_remedy: str = "",
) -> None:
    """Refuse a recording that cannot be of an arm.

    Args:
        description: The arm.
        episode: Each frame's episode, shape (N,); frames of an episode follow each other.
        joints: Measured, (N, dof).
        commands: Target joints, (N, dof), or None.
        current_pose: `T_base_tool` measured, (N, 7), or None.
        target_pose: `T_base_tool` asked for, (N, 7), or None.
        where: The dataset, for messages.
        joints_remedy: What the user can do where joints are in another unit.

    Raises:
        ValueError: A number is not finite, joints are far outside the limits, poses far outside the reach, or
            quaternions in another order than xyzw; it names column, episode and frame, and the remedy.
    """
    columns = [each for each in (joints, commands, current_pose, target_pose) if each is not None]
    for column in columns:
        bad = ~np.isfinite(column.values)
        if bad.any():
            row, element = np.argwhere(bad)[0]
            raise ValueError(
                f"{where}: {column.name} is not finite in {int(bad.any(axis=1).sum())} frames, first "
                f"{column.elements[element]} in {_place(episode, int(row))}. Remedy: leave these episodes out, "
                "or repair them."
            )
    reasons = _reasons(description, joints, commands, current_pose, target_pose, joints_remedy)
    for column, reason, remedy in reasons:
        if reason is not None:
            raise ValueError(f"{where}: {column.name}: {reason}." + (f" Remedy: {remedy}" if remedy else ""))


def _reasons(
    description: ArmDescription,
    joints: Column,
    commands: Column | None,
    current_pose: Column | None,
    target_pose: Column | None,
    joints_remedy: str,
) -> Iterator[tuple[Column, str | None, str]]:
    yield joints, why_not_joints(description, joints.values), joints_remedy
    if commands is not None:
        yield commands, why_not_joints(description, commands.values, COMMANDS_OUTSIDE_LIMITS), joints_remedy
    for pose, same_time in ((current_pose, joints), (target_pose, commands or joints)):
        if pose is not None:
            yield pose, why_not_poses(description, pose.values), "convert the positions to metres."
            reason = why_not_order(description, same_time.values, pose.values)
            yield pose, reason, "reorder the quaternions to x y z w."


def _place(episode: NDArray[np.integer], row: int) -> str:
    number = episode[row]
    return f"episode {int(number)}, frame {row - int(np.argmax(episode == number))}"
