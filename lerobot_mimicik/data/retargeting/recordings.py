"""Reading end-effector recordings: parquet and CSV tables, UMI-style tables, LeRobot datasets with poses.

Whatever the source calls its columns, what comes out is a list of `Recording`: stamps, poses (x y z qx qy qz
qw in the recording's own frame, metres), sometimes a gripper, and the session it belongs to. Nothing is
repaired here (see `cleaning`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_mimicik.data.lerobot_tables import (
    STATE,
    component_names,
    is_lerobot,
    read_lerobot,
    task_sentences,
)
from lerobot_mimicik.data.retargeting.pose_columns import PoseColumns, find_pose_columns, gather_poses
from lerobot_mimicik.data.tables import (
    TableColumns,
    find_joint_columns,
    group_rows,
    guess_one,
    numeric,
    read_parquet,
    read_table,
    spans,
    table_files,
)

if TYPE_CHECKING:
    import pandas as pd

POSITION_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


@dataclass(frozen=True)
class SourceColumns(TableColumns):
    """Which columns of the source mean what; an empty field is guessed from the names usual in the field.

    Attributes:
        position: Three columns, or one column of 3-vectors.
        position_unit: One of `POSITION_UNITS`.
        rotation: Four columns (quaternion) or three (rotation vector), or one column of such vectors.
        quaternion_order: "xyzw" or "wxyz".
        gripper: Gripper width or opening, passed through.
    """

    position: tuple[str, ...] = ()
    position_unit: str = "m"
    rotation: tuple[str, ...] = ()
    quaternion_order: str = "xyzw"
    gripper: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.position_unit not in POSITION_UNITS:
            raise ValueError(
                f"position_unit must be one of {', '.join(POSITION_UNITS)}, got {self.position_unit!r}"
            )
        if self.quaternion_order not in ("xyzw", "wxyz"):
            raise ValueError(f"quaternion_order must be 'xyzw' or 'wxyz', got {self.quaternion_order!r}")


@dataclass
class Recording:
    """One raw recording of T frames.

    Attributes:
        name: Unique within the source, such as "person=11/session=1/episode=104".
        session: Who recorded it and when.
        t: Stamps [s], shape (T,), as recorded (they may repeat or run backwards).
        pose: x y z qx qy qz qw in the recording's frame, shape (T, 7); quaternions as recorded, not
            normalised.
        gripper: Shape (T,) or None.
        task: Sentence, empty if the source has none.
        joints: The arm's joints at the same moments as recorded, shape (T, dof), or None.
    """

    name: str
    session: str
    t: np.ndarray
    pose: np.ndarray
    gripper: np.ndarray | None = None
    task: str = ""
    joints: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.t)


def load_recordings(
    source: str | Path, columns: SourceColumns | None = None, joint_names: Sequence[str] = ()
) -> list[Recording]:
    """All recordings of a parquet or CSV file, a folder of such files, or a LeRobot v3 dataset, in order.

    Args:
        source: Where they are.
        columns: What its columns mean.
        joint_names: Of an arm that may have been recorded too.

    Raises:
        FileNotFoundError: Nothing at `source`.
        ValueError: A format or columns that are not understood; the message lists the columns that exist.
    """
    source, columns = Path(source), columns or SourceColumns()
    if is_lerobot(source):
        return _load_lerobot(source, columns, joint_names)
    return [
        recording
        for path in table_files(source)
        for recording in _split_table(read_table(path), columns, str(path), path.name, joint_names)
    ]


def _split_table(
    table: pd.DataFrame, columns: SourceColumns, where: str, default_name: str, joint_names: Sequence[str]
) -> list[Recording]:
    """Cut a table into recordings by its group columns."""
    found = find_pose_columns(table, columns.position, columns.rotation, where)
    gripper = guess_one(table, columns.gripper, "gripper", where)
    opening = None if gripper is None else numeric(table, [gripper], where)[:, 0]
    pose = _poses(table, found, columns, where)
    named = find_joint_columns(table.columns, joint_names) if joint_names else None
    joints = numeric(table, named, where) if named else None
    return [
        Recording(
            name=span.name,
            session=span.session,
            t=span.t,
            pose=pose[span.rows],
            gripper=None if opening is None else opening[span.rows],
            task=span.task,
            joints=None if joints is None else joints[span.rows],
        )
        for span in spans(table, columns, where, default_name)
    ]


def _poses(table: pd.DataFrame, found: PoseColumns, columns: SourceColumns, where: str) -> np.ndarray:
    """Poses (rows, 7) in metres."""
    pose = gather_poses(table, found, columns.quaternion_order, where)
    pose[:, :3] *= POSITION_UNITS[columns.position_unit]
    return pose


def _load_lerobot(root: Path, columns: SourceColumns, joint_names: Sequence[str]) -> list[Recording]:
    """Recordings of a LeRobot v3 dataset: one per episode, from the first feature that holds poses."""
    table, info = read_lerobot(root)
    features: dict[str, dict[str, Any]] = info["features"]
    found = find_pose_columns(table, columns.position, columns.rotation, str(root), features)
    pose = _poses(table, found, columns, str(root))
    joints = _lerobot_joints(table, info, joint_names)
    gripper = _lerobot_gripper(table, info, columns.gripper, found, str(root))
    tasks, sessions = task_sentences(root), _lerobot_sessions(root)
    fps = float(info["fps"])
    time = (
        table["timestamp"].to_numpy(dtype=np.float64)
        if "timestamp" in table
        else table["frame_index"].to_numpy(dtype=np.float64) / fps
    )
    recordings = []
    for rows in group_rows(table, ("episode_index",)):
        episode = int(table["episode_index"].iloc[rows[0]])
        task = tasks.get(int(table["task_index"].iloc[rows[0]]), "") if "task_index" in table else ""
        recordings.append(
            Recording(
                name=f"episode={episode}",
                session=sessions.get(episode, f"episode={episode}"),
                t=time[rows],
                pose=pose[rows],
                gripper=None if gripper is None else gripper[rows],
                task=task,
                joints=None if joints is None else joints[rows],
            )
        )
    return recordings


def _lerobot_joints(
    table: pd.DataFrame, info: dict[str, Any], joint_names: Sequence[str]
) -> np.ndarray | None:
    """The joints among the named components of the state, (rows, dof), if they are there."""
    names = component_names(info, STATE)
    found = find_joint_columns(names, joint_names) if joint_names and STATE in table else None
    if found is None:
        return None
    state = np.stack(table[STATE].to_numpy()).astype(np.float64)
    return state[:, [names.index(name) for name in found]]


def _lerobot_gripper(
    table: pd.DataFrame,
    info: dict[str, Any],
    name: str,
    found: PoseColumns,
    where: str,
) -> np.ndarray | None:
    """The gripper: a column of its own, or a component of the state whose name speaks of a gripper."""
    column = guess_one(table, name, "gripper", where)
    if column is not None:
        return np.stack(table[column].to_numpy()).reshape(len(table), -1)[:, 0].astype(np.float64)
    for key in (found.position[0], STATE):
        for index, component in enumerate(component_names(info, key)):
            if "gripper" in component.lower():
                return np.stack(table[key].to_numpy())[:, index].astype(np.float64)
    return None


def _lerobot_sessions(root: Path) -> dict[int, str]:
    """Session by episode index, as far as the dataset states them."""
    sessions: dict[int, str] = {}
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        table = read_parquet(path)
        if "session" in table:
            sessions |= {
                int(e): str(s) for e, s in zip(table["episode_index"], table["session"], strict=True)
            }
    return sessions
