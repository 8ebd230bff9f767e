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

from lerobot_mimicik.data.retargeting.pose_columns import (
    GROUPS,
    PoseColumns,
    find_pose_columns,
    gather_poses,
    guess_one,
)

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TABLE_SUFFIXES = (".parquet", ".csv", ".csv.gz", ".tsv")


@dataclass(frozen=True)
class SourceColumns:
    """Which columns of the source mean what; an empty field is guessed from the names usual in the field.

    Attributes:
        time: stamps. A table without stamps needs `fps`.
        time_unit: s, ms, us, ns; empty: seconds if the median step lies between 0.1 ms and 2 s, else the
            first of ms, us, ns for which it does.
        fps: frame rate of a source without stamps [Hz], 0 if it has them.
        position: three columns, or one column of 3-vectors [m].
        rotation: four columns (quaternion) or three (rotation vector), or one column of such vectors.
        quaternion_order: "xyzw" or "wxyz".
        groups: columns that together name one recording.
        session: columns that together name a session; default: `groups` without the last.
        gripper: gripper width or opening, passed through.
        task: what is done, a sentence per row.
    """

    time: str = ""
    time_unit: str = ""
    fps: float = 0.0
    position: tuple[str, ...] = ()
    rotation: tuple[str, ...] = ()
    quaternion_order: str = "xyzw"
    groups: tuple[str, ...] = ()
    session: tuple[str, ...] = ()
    gripper: str = ""
    task: str = ""

    def __post_init__(self) -> None:
        if self.quaternion_order not in ("xyzw", "wxyz"):
            raise ValueError(f"quaternion_order must be 'xyzw' or 'wxyz', got {self.quaternion_order!r}")
        if self.time_unit and self.time_unit not in TIME_UNITS:
            raise ValueError(f"time_unit must be one of {', '.join(TIME_UNITS)}, got {self.time_unit!r}")


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
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.name.endswith(TABLE_SUFFIXES))
        if not files:
            raise ValueError(
                f"{source} is neither a LeRobot dataset (no meta/info.json) nor a folder of "
                f"{', '.join(TABLE_SUFFIXES)} files"
            )
        recordings = []
        for path in files:
            recordings += _split_table(_read_table(path), columns, str(path), default_name=path.name)
        return recordings
    if not source.exists():
        raise FileNotFoundError(f"input {source} does not exist")
    return _split_table(_read_table(source), columns, str(source), default_name=source.name)


def _read_table(path: Path) -> pd.DataFrame:
    if path.name.endswith(".parquet"):
        return pd.read_parquet(path)
    if path.name.endswith(TABLE_SUFFIXES):
        return pd.read_csv(path, sep="\t" if path.suffix == ".tsv" else ",")
    raise ValueError(
        f"{path}: expected {', '.join(TABLE_SUFFIXES)} or a LeRobot dataset folder "
        "(convert zarr to one of these first)"
    )


def _split_table(
    table: pd.DataFrame, columns: SourceColumns, where: str, default_name: str
) -> list[Recording]:
    """Cut a table into recordings by its group columns."""
    if table.empty:
        raise ValueError(f"{where} has no rows")
    found = find_pose_columns(table, columns.position, columns.rotation, where)
    groups = _existing(table, columns.groups, where, "group") or tuple(
        name for name in GROUPS if name in table.columns
    )
    session = _existing(table, columns.session, where, "session") or groups[:-1]
    time, gripper = _time(table, columns, where), guess_one(table, columns.gripper, "gripper", where)
    task = guess_one(table, columns.task, "task", where)
    pose = gather_poses(table, found, columns.quaternion_order, where)
    return [
        Recording(
            name=_label(table, groups, rows[0]) or default_name,
            session=_label(table, session, rows[0]) or _label(table, groups, rows[0]) or default_name,
            t=time[rows],
            pose=pose[rows],
            gripper=None if gripper is None else table[gripper].to_numpy(dtype=np.float64)[rows],
            task="" if task is None else str(table[task].iloc[rows[0]]),
        )
        for rows in _group_rows(table, groups)
    ]


def _group_rows(table: pd.DataFrame, groups: tuple[str, ...]) -> list[np.ndarray]:
    if not groups:
        return [np.arange(len(table))]
    missing = [name for name in groups if table[name].isna().any()]
    if missing:
        raise ValueError(f"group column {missing[0]!r} has empty cells; every row must belong to a recording")
    number = table.groupby(list(groups), sort=False).ngroup().to_numpy()
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def _label(table: pd.DataFrame, names: tuple[str, ...], row: int) -> str:
    return "/".join(f"{name}={table[name].iloc[row]}" for name in names)


def _existing(table: pd.DataFrame, names: tuple[str, ...], where: str, role: str) -> tuple[str, ...]:
    missing = [name for name in names if name not in table.columns]
    if missing:
        raise ValueError(
            f"{where} has no {role} column {missing[0]!r}; its columns: {', '.join(map(str, table.columns))}"
        )
    return tuple(names)


def _time(table: pd.DataFrame, columns: SourceColumns, where: str) -> np.ndarray:
    """Stamps in seconds; rows counted at the given rate if there are none."""
    name = guess_one(table, columns.time, "time", where)
    if name is None:
        if columns.fps <= 0:
            raise ValueError(
                f"{where} has no time column (looked for the usual names) and no frame rate was given; "
                f"its columns: {', '.join(map(str, table.columns))}"
            )
        return np.arange(len(table)) / columns.fps
    stamps = table[name]
    present = stamps.dropna()
    if present.empty:
        raise ValueError(f"{where}: time column {name!r} holds no stamp")
    if pd.api.types.is_datetime64_any_dtype(stamps):
        return (stamps - present.iloc[0]).dt.total_seconds().to_numpy()
    if not pd.api.types.is_numeric_dtype(stamps):
        raise ValueError(f"{where}: time column {name!r} holds {stamps.dtype}, expected numbers or datetimes")
    # The origin goes first: nanoseconds since 1970 do not fit a float64 to the microsecond.
    values = (stamps - present.iloc[0]).to_numpy(dtype=np.float64)
    return values * _time_scale(values, columns.time_unit, f"{where}, column {name!r}")


def _time_scale(values: np.ndarray, unit: str, where: str) -> float:
    if unit:
        return TIME_UNITS[unit]
    steps = np.diff(values)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if len(steps) == 0:
        return 1.0
    for scale in TIME_UNITS.values():
        if 1e-4 <= np.median(steps) * scale <= 2.0:
            return scale
    raise ValueError(
        f"{where}: the median step of {np.median(steps):g} is no plausible frame time; give its unit"
    )


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
    for rows in _group_rows(table, ("episode_index",)):
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
