"""Finding poses in a table: which columns hold position and rotation, whatever the source calls them.

A pose is spread over scalar columns (x y z qx qy qz qw), held in vector columns (UMI's `robot0_eef_pos`
and `robot0_eef_rot_axis_angle`), or is part of a longer vector whose components have names (LeRobot
features).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

_POSITION = (
    ("x", "y", "z"), ("px", "py", "pz"), ("pos_x", "pos_y", "pos_z"), ("tx", "ty", "tz"),
    ("position_x", "position_y", "position_z"), ("position.x", "position.y", "position.z"),
    ("ee_x", "ee_y", "ee_z"),
    ("ee.x", "ee.y", "ee.z"), ("robot0_eef_pos_0", "robot0_eef_pos_1", "robot0_eef_pos_2"),
)  # fmt: skip
_POSITION_VECTORS = ("robot0_eef_pos", "eef_pos", "ee_pos", "position", "pos", "translation")
_QUATERNION = (
    ("qx", "qy", "qz", "qw"), ("quat_x", "quat_y", "quat_z", "quat_w"), ("ox", "oy", "oz", "ow"),
    ("quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w"), ("rot_x", "rot_y", "rot_z", "rot_w"),
    ("orientation_x", "orientation_y", "orientation_z", "orientation_w"),
    ("orientation.x", "orientation.y", "orientation.z", "orientation.w"),
    ("ee.qx", "ee.qy", "ee.qz", "ee.qw"),
)  # fmt: skip
_ROTATION_VECTOR = (
    ("wx", "wy", "wz"), ("rx", "ry", "rz"), ("rotvec_x", "rotvec_y", "rotvec_z"), ("ee.wx", "ee.wy", "ee.wz"),
    ("robot0_eef_rot_axis_angle_0", "robot0_eef_rot_axis_angle_1", "robot0_eef_rot_axis_angle_2"),
)  # fmt: skip
_ROTATION_VECTORS = (
    "robot0_eef_rot_axis_angle", "eef_rot_axis_angle", "rotvec", "rotation_vector", "axis_angle",
    "quaternion", "quat", "orientation", "rotation",
)  # fmt: skip
_LEROBOT_POSES = ("observation.ee_pose", "observation.ee_target", "observation.state", "action")


@dataclass(frozen=True)
class PoseColumns:
    """Where a table keeps its poses.

    `position` and `rotation` are column names: one per component, or a single one that holds vectors, of
    which `position_index` and `rotation_index` are the components (empty: all).
    """

    position: tuple[str, ...]
    rotation: tuple[str, ...]
    position_index: tuple[int, ...] = ()
    rotation_index: tuple[int, ...] = ()


def find_pose_columns(
    table: pd.DataFrame,
    position: tuple[str, ...],
    rotation: tuple[str, ...],
    where: str,
    features: dict[str, dict[str, Any]] | None = None,
) -> PoseColumns:
    """Where the poses are: in the columns asked for, else in those with usual names.

    Args:
        table: The data.
        position: Columns asked for, or ().
        rotation: Columns asked for, or ().
        where: The source, for messages.
        features: LeRobot features, whose component names are searched too.

    Raises:
        ValueError: Columns asked for do not exist, or nothing was found; lists the columns that exist.
    """
    for name in (*position, *rotation):
        if name not in table.columns:
            raise ValueError(f"{where} has no column {name!r}; its columns: {_described(table, features)}")
    if not position and not rotation and features is not None:
        for key in _LEROBOT_POSES:
            found = _in_vector(key, features.get(key, {}))
            if found is not None:
                return found
    # Parts of one feature's vector, when the user named that feature alone.
    if features is not None and len(position) == 1 and position == (rotation or position):
        found = _in_vector(position[0], features.get(position[0], {}))
        if found is not None:
            return found
    position = position or _first(table, _POSITION, _POSITION_VECTORS)
    rotation = rotation or _first(table, (*_QUATERNION, *_ROTATION_VECTOR), _ROTATION_VECTORS)
    for found_names, what, widths in ((position, "position", (1, 3)), (rotation, "rotation", (1, 3, 4))):
        if not found_names:
            raise ValueError(
                f"{where}: found no {what} columns under the usual names; name them. Its columns: "
                f"{_described(table, features)}"
            )
        if len(found_names) not in widths:
            raise ValueError(
                f"{where}: {what} takes {' or '.join(map(str, widths))} columns, got {found_names}"
            )
    return PoseColumns(position, rotation)


def gather_poses(table: pd.DataFrame, found: PoseColumns, quaternion_order: str, where: str) -> np.ndarray:
    """Poses x y z qx qy qz qw, shape (rows, 7), float64; rotation vectors are turned into quaternions.

    Quaternions come as recorded: neither normalised nor of one sign, and not finite where the source is not.
    """
    position = _gather(table, found.position, found.position_index, where)
    rotation = _gather(table, found.rotation, found.rotation_index, where)
    if position.shape[1] != 3:
        raise ValueError(f"{where}: position {found.position} has {position.shape[1]} components, expected 3")
    if rotation.shape[1] == 3:
        half = 0.5 * np.linalg.norm(rotation, axis=1, keepdims=True)
        rotation = np.concatenate([0.5 * np.sinc(half / np.pi) * rotation, np.cos(half)], axis=1)
    elif rotation.shape[1] != 4:
        raise ValueError(
            f"{where}: rotation {found.rotation} has {rotation.shape[1]} components, expected 3 (rotation "
            "vector) or 4 (quaternion)"
        )
    elif quaternion_order == "wxyz":
        rotation = rotation[:, [1, 2, 3, 0]]
    return np.concatenate([position, rotation], axis=1)


def _first(
    table: pd.DataFrame, scalars: tuple[tuple[str, ...], ...], vectors: tuple[str, ...]
) -> tuple[str, ...]:
    for names in scalars:
        if all(name in table.columns for name in names):
            return names
    return next(((name,) for name in vectors if name in table.columns), ())


def _in_vector(key: str, feature: dict[str, Any]) -> PoseColumns | None:
    """A pose among the named components of a LeRobot feature, or None."""
    names = feature.get("names") or []
    if isinstance(names, dict):
        names = next(iter(names.values()))
    bare = [re.sub(r"\.pos$", "", re.sub(r"^(ee|eef|tool|tcp)[._]", "", str(name).lower())) for name in names]
    for rotation in (*_QUATERNION, *_ROTATION_VECTOR):
        if all(name in bare for name in ("x", "y", "z", *rotation)):
            return PoseColumns(
                (key,), (key,), tuple(map(bare.index, "xyz")), tuple(bare.index(name) for name in rotation)
            )
    return None


def _gather(table: pd.DataFrame, names: tuple[str, ...], index: tuple[int, ...], where: str) -> np.ndarray:
    try:
        if len(names) > 1:
            return table[list(names)].to_numpy(dtype=np.float64)
        rows = np.stack([np.asarray(row, dtype=np.float64) for row in table[names[0]]])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: columns {names} do not hold numbers of one length: {error}") from error
    rows = rows.reshape(len(rows), -1)
    return rows[:, list(index)] if index else rows


def _described(table: pd.DataFrame, features: dict[str, dict[str, Any]] | None) -> str:
    if features is None:
        return ", ".join(map(str, table.columns))
    return "; ".join(
        f"{key} {features[key].get('names') or ''}".strip() for key in table.columns if key in features
    )
