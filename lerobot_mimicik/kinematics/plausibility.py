"""Whether numbers can be an arm's joints and tool poses: a wrong unit or quaternion order shows in them.

Each judgement returns a reason to refuse the numbers, or None. Numbers that are merely unusual pass: joints a little
outside their limits, targets out of reach. Numbers that are not finite are not judged here.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.names import listed

Array = NDArray[np.float64]

FAR_OUTSIDE_LIMITS = 0.5
"""rad, m: further out than calibration and sag bring a joint (0.1 on real arms); degrees overshoot by tens."""
COMMANDS_OUTSIDE_LIMITS = 6.3
"""rad, m: the same for commands, a turn: a leader arm may be moved where the follower cannot go (1.8 in real data)."""
FAR_OUTSIDE_REACH = 5.0
"""Arm lengths: an operator's target may be out of reach, but not there; millimetres are a thousand times too far."""
_ORDER_MISFIT, _ORDER_FIT = 0.5, 0.1
"""rad: between FK and poses in the wrong order of the quaternion, and in the right one."""
_SAME_LENGTH, _SAME_ANGLE = 0.02, 0.1
"""m, rad: a calibrated arm differs less from its drawing."""
_ORDER_FRAMES = 1000
"""Frames, evenly spaced, that the order of the quaternion is judged by."""


def why_not_joints(
    description: ArmDescription, joints: ArrayLike, margin: float = FAR_OUTSIDE_LIMITS
) -> str | None:
    """Why numbers cannot be the arm's joints, or None: one of them is far outside the joint's limits.

    Args:
        description: The arm.
        joints: In rad (m where a joint slides), shape (dof,) or (T, dof).
        margin: How far outside is far [rad, m]; `COMMANDS_OUTSIDE_LIMITS` for recorded commands.

    Returns:
        The reason, which names joint, value, limits and frame, and whether the numbers would fit in degrees.

    Raises:
        ValueError: The last axis is not the arm's number of joints.
    """
    lower, upper = joint_limits(description)
    values = _rows(joints, len(lower), "joints")
    beyond = _beyond(values, lower, upper)
    if not (beyond > margin).any():
        return None
    frame, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
    radians = _beyond(np.radians(values), lower, upper).max() <= margin
    return (
        f"{description.joint_names[joint]} is {values[frame, joint]:.4g} rad"
        + (f" in frame {frame}" if len(values) > 1 else "")
        + f", far outside its limits [{lower[joint]:.4g}, {upper[joint]:.4g}]"
        + (
            ": as degrees the numbers would fit"
            if radians
            else ": another unit, another arm, or other numbers than joints"
        )
    )


def why_not_poses(description: ArmDescription, poses: ArrayLike) -> str | None:
    """Why numbers cannot be poses of the arm's tool, or None: a position is far outside the arm's reach.

    Args:
        description: The arm.
        poses: `T_base_tool`, x y z [m] and anything after them, shape (>= 3,) or (T, >= 3).

    Returns:
        The reason, which names position, reach and frame, and whether the numbers would fit in millimetres.

    Raises:
        ValueError: Fewer than three numbers a pose.
    """
    numbers = np.asarray(poses, dtype=float)
    if numbers.ndim not in (1, 2) or numbers.shape[-1] < 3:
        raise ValueError(f"expected poses of shape (7,) or (T, 7), got {numbers.shape}")
    positions = np.atleast_2d(numbers)[:, :3]
    with np.errstate(over="ignore"):
        distance = np.hypot.reduce(np.where(np.isfinite(positions), positions, 0.0), axis=1)
    reach = upper_reach(description)
    if not (distance > FAR_OUTSIDE_REACH * reach).any():
        return None
    frame = int(distance.argmax())
    millimetres = distance.max() / 1e3 <= FAR_OUTSIDE_REACH * reach
    return (
        f"the position {' '.join(f'{value:.4g}' for value in positions[frame])} m"
        + (f" in frame {frame}" if len(positions) > 1 else "")
        + f" is {distance[frame]:.4g} m from the arm's base, whose reach is at most {reach:.3g} m"
        + (
            ": as millimetres the numbers would fit"
            if millimetres
            else ": another unit, or another frame than the base"
        )
    )


def why_not_order(description: ArmDescription, joints: ArrayLike, poses: ArrayLike) -> str | None:
    """Why quaternions cannot be in the order xyzw, or None: FK of the joints has the order wxyz.

    Poses of another tool, or in another base, are judged by how the orientation turns with the joints, if it does.

    Args:
        description: The arm.
        joints: In rad, shape (T, dof).
        poses: `T_base_tool` of the same moments, x y z [m] and a quaternion, shape (T, 7).

    Raises:
        ValueError: The shapes do not fit each other or the arm.
    """
    q = _rows(joints, len(description.joint_names), "joints")
    numbers = np.atleast_2d(np.asarray(poses, dtype=float))
    if numbers.shape != (len(q), 7):
        raise ValueError(f"expected poses of shape {(len(q), 7)} with joints {q.shape}, got {numbers.shape}")
    usable = np.isfinite(q).all(1) & np.isfinite(numbers).all(1) & (np.abs(numbers[:, 3:]).max(1) > 1e-6)
    rows = np.flatnonzero(usable)[:: max(1, int(usable.sum()) // _ORDER_FRAMES)]
    if not len(rows):
        return None
    turned = Rotation.from_matrix(array_chain(description).forward(q[rows])[0])
    as_read = _misfits(turned, Rotation.from_quat(numbers[rows, 3:]))
    other = _misfits(turned, Rotation.from_quat(numbers[rows][:, [4, 5, 6, 3]]))
    for ours, theirs in zip(as_read, other, strict=True):
        if ours > _ORDER_MISFIT and theirs < _ORDER_FIT:
            return (
                f"the quaternions read as x y z w are {ours:.2f} rad away from FK of the joints, read as "
                f"w x y z {theirs:.2f} rad: they are in the order w x y z"
            )
    return None


def why_not_same_arm(one: ArmDescription, other: ArmDescription) -> str | None:
    """Why two descriptions are of different arms, or None: joints of other names, or axes that lie otherwise.

    Links, tools, base and limits may differ, and lengths by what a calibration changes.
    """
    if one.joint_names != other.joint_names:
        return f"joints {listed(one.joint_names)} and {listed(other.joint_names)}"
    for ours, theirs in zip(_between_axes(one), _between_axes(other), strict=True):
        if abs(ours[0] - theirs[0]) > _SAME_LENGTH or abs(ours[1] - theirs[1]) > _SAME_ANGLE:
            return (
                f"two successive joint axes are {ours[0] * 1e3:.0f} mm and {ours[1]:.2f} rad apart in one, "
                f"{theirs[0] * 1e3:.0f} mm and {theirs[1]:.2f} rad in the other"
            )
    return None


def _between_axes(description: ArmDescription) -> list[tuple[float, float]]:
    """Distance [m] and angle [rad] between the axes of each joint and the next, which no frames change."""
    found = []
    for rotation, position in array_chain(description).steps[1:]:
        axis = rotation[:, 2]
        normal = np.cross([0.0, 0.0, 1.0], axis)
        sine = float(np.linalg.norm(normal))
        distance = abs(position @ normal) / sine if sine > 1e-3 else np.linalg.norm(position[:2])
        found.append((float(distance), float(np.arctan2(sine, axis[2]))))
    return found


def check_plausible(
    description: ArmDescription,
    joints: ArrayLike | None = None,
    poses: ArrayLike | None = None,
    *,
    what: str = "",
    joints_remedy: str = "",
    poses_remedy: str = "",
) -> None:
    """Refuse joints or poses that cannot be the arm's; the order of quaternions is `why_not_order`'s.

    Args:
        description: The arm.
        joints: As `why_not_joints`; None: not judged.
        poses: As `why_not_poses`; None: not judged.
        what: Where the numbers are from, which begins the message: a file, a column.
        joints_remedy: What the user can do about joints, which ends the message: `--policy.joint_units=deg`.
        poses_remedy: The same for poses.

    Raises:
        ValueError: They cannot; the message has the reason and the remedy.
    """
    judgements = (
        (None if joints is None else why_not_joints(description, joints), joints_remedy),
        (None if poses is None else why_not_poses(description, poses), poses_remedy),
    )
    for reason, remedy in judgements:
        if reason is not None:
            raise ValueError(
                f"{what}{': ' if what else ''}{reason}." + (f" Remedy: {remedy}" if remedy else "")
            )


@functools.lru_cache(maxsize=8)
def joint_limits(description: ArmDescription) -> tuple[Array, Array]:
    """Lower and upper limits, each (dof,), rad or m; infinite where a joint turns without end. Read-only."""
    joints = description.joints()
    limits = np.array([[joint.lower for joint in joints], [joint.upper for joint in joints]])
    limits.flags.writeable = False
    return limits[0], limits[1]


@functools.lru_cache(maxsize=8)
def upper_reach(description: ArmDescription) -> float:
    """No tool position is further from the base than this [m]: the lengths of the links and slides in a line."""
    slides = [
        max(abs(joint.lower), abs(joint.upper)) for joint in description.joints() if joint.type == "prismatic"
    ]
    return array_chain(description).stretched_length(0) + sum(slides)


def _rows(values: ArrayLike, width: int, what: str) -> Array:
    rows = np.asarray(values, dtype=float)
    if rows.ndim not in (1, 2) or rows.shape[-1] != width:
        raise ValueError(f"expected {what} of shape ({width},) or (T, {width}), got {rows.shape}")
    return np.atleast_2d(rows)


def _beyond(values: Array, lower: Array, upper: Array) -> Array:
    """How far outside the limits, zero inside and where a value is not finite."""
    return np.where(np.isfinite(values), np.maximum(np.maximum(lower - values, values - upper), 0.0), 0.0)


def _misfits(turned: Rotation, read: Rotation) -> tuple[float, float]:
    """Median angles [rad] between two sequences of orientations: as they are, and with whatever constant tool or
    base between them fits best.
    """
    direct = float(np.median((turned.inv() * read).magnitude()))
    offsets = (turned.inv() * read, read * turned.inv())
    return direct, min(float(np.median((each.mean().inv() * each).magnitude())) for each in offsets)
