"""Reading end-effector recordings: parquet and CSV tables, UMI-style tables, LeRobot datasets with poses.

Whatever the source calls its columns, what comes out is a list of `Recording`: stamps, poses (x y z qx qy qz
qw in the recording's own frame, metres), sometimes a gripper, and the session it belongs to. Nothing is
repaired here (see `cleaning`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lerobot_mimicik.data.retargeting.pose_columns import PoseColumns, find_pose_columns, gather_poses
from lerobot_mimicik.data.tables import TableColumns, group_rows, guess_one, read_table, spans, table_files


@dataclass(frozen=True)
class SourceColumns(TableColumns):
    """Which columns of the source mean what; an empty field is guessed from the names usual in the field.

    Attributes:
        position: three columns, or one column of 3-vectors [m].
        rotation: four columns (quaternion) or three (rotation vector), or one column of such vectors.
        quaternion_order: "xyzw" or "wxyz".
        gripper: gripper width or opening, passed through.
    """

    position: tuple[str, ...] = ()
    rotation: tuple[str, ...] = ()
    quaternion_order: str = "xyzw"
    gripper: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quaternion_order not in ("xyzw", "wxyz"):
            raise ValueError(f"quaternion_order must be 'xyzw' or 'wxyz', got {self.quaternion_order!r}")


@dataclass
class Recording:
    """One raw recording of T frames.

    Attributes:
        name: unique within the source, such as "person=11/session=1/episode=104".
        session: who recorded it and when.
        t: stamps [s], shape (T,), as recorded (they may repeat or run backwards).
        pose: x y z qx qy qz qw in the recording's frame, shape (T, 7); quaternions as recorded, not
            normalised.
        gripper: shape (T,) or None.
        task: sentence, empty if the source has none.
    """

    name: str
    session: str
    t: np.ndarray
    pose: np.ndarray
    gripper: np.ndarray | None = None
    task: str = ""

    def __len__(self) -> int:
        return len(self.t)


def load_recordings(source: str | Path, columns: SourceColumns | None = None) -> list[Recording]:
    """All recordings of a parquet or CSV file, a folder of such files, or a LeRobot v3 dataset, in order.

    Raises:
        FileNotFoundError: nothing at `source`.
        ValueError: a format or columns that are not understood; the message lists the columns that exist.
    """
    source, columns = Path(source), columns or SourceColumns()
    if (source / "meta" / "info.json").is_file():
        return _load_lerobot(source, columns)
    return [
        recording
        for path in table_files(source)
        for recording in _split_table(read_table(path), columns, str(path), default_name=path.name)
    ]


def _split_table(
    table: pd.DataFrame, columns: SourceColumns, where: str, default_name: str
) -> list[Recording]:
    """Cut a table into recordings by its group columns."""
    found = find_pose_columns(table, columns.position, columns.rotation, where)
    gripper = guess_one(table, columns.gripper, "gripper", where)
    pose = gather_poses(table, found, columns.quaternion_order, where)
    return [
        Recording(
            name=span.name,
            session=span.session,
            t=span.t,
            pose=pose[span.rows],
            gripper=None if gripper is None else table[gripper].to_numpy(dtype=np.float64)[span.rows],
            task=span.task,
        )
        for span in spans(table, columns, where, default_name)
    ]


def _load_lerobot(root: Path, columns: SourceColumns) -> list[Recording]:
    """Recordings of a LeRobot v3 dataset: one per episode, from the first feature that holds poses."""
    info = json.loads((root / "meta" / "info.json").read_text())
    features: dict[str, dict[str, Any]] = info["features"]
    wanted = [key for key, ft in features.items() if ft["dtype"] not in ("video", "image")]
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(f"LeRobot dataset {root} has no data/*/*.parquet")
    table = pd.concat([pd.read_parquet(path, columns=wanted) for path in files], ignore_index=True)
    found = find_pose_columns(table, columns.position, columns.rotation, str(root), features)
    pose = gather_poses(table, found, columns.quaternion_order, str(root))
    gripper = _lerobot_gripper(table, features, columns.gripper, found, str(root))
    tasks, sessions = _lerobot_metadata(root)
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
            )
        )
    return recordings


def _lerobot_gripper(
    table: pd.DataFrame,
    features: dict[str, dict[str, Any]],
    name: str,
    found: PoseColumns,
    where: str,
) -> np.ndarray | None:
    """The gripper: a column of its own, or a component of the state whose name speaks of a gripper."""
    column = guess_one(table, name, "gripper", where)
    if column is not None:
        return np.stack(table[column].to_numpy()).reshape(len(table), -1)[:, 0].astype(np.float64)
    for key in (found.position[0], "observation.state"):
        names = features.get(key, {}).get("names") or []
        names = next(iter(names.values())) if isinstance(names, dict) else names
        for index, component in enumerate(names):
            if "gripper" in str(component).lower():
                return np.stack(table[key].to_numpy())[:, index].astype(np.float64)
    return None


def _lerobot_metadata(root: Path) -> tuple[dict[int, str], dict[int, str]]:
    """Task by task index and session by episode index, as far as the dataset states them."""
    tasks: dict[int, str] = {}
    if (root / "meta" / "tasks.parquet").is_file():
        table = pd.read_parquet(root / "meta" / "tasks.parquet")
        tasks = {int(index): str(task) for task, index in table["task_index"].items()}
    sessions: dict[int, str] = {}
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        table = pd.read_parquet(path)
        if "session" in table:
            sessions |= {
                int(e): str(s) for e, s in zip(table["episode_index"], table["session"], strict=True)
            }
    return tasks, sessions
