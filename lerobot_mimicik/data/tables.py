"""Recorded tables, parquet or CSV: finding the files, the recordings in them, their stamps and usual columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TABLE_SUFFIXES = (".parquet", ".csv", ".csv.gz", ".tsv")
GROUPS = (
    "person", "subject", "participant", "user", "operator", "session", "session_id",
    "recording", "recording_id", "trajectory", "trajectory_id", "demo", "demo_id",
    "episode", "episode_id", "episode_index",
)  # fmt: skip
# How a table may call joint number i (from one) with this name.
_JOINTS = ("{name}", "{name}.pos", "q{i}", "joint{i}", "joint_{i}", "joint{i}.pos", "joint_{i}.pos")
_ONE = {
    "time": ("t", "time", "timestamp", "timestamps", "stamp", "time_s", "timestamp_s", "robot_timestamp"),
    "gripper": (
        "gripper.pos",
        "gripper",
        "gripper_width",
        "robot0_gripper_width",
        "gripper_pos",
        "gripper_position",
    ),
    "task": ("task", "instruction", "language_instruction"),
}


@dataclass(frozen=True)
class TableColumns:
    """Which columns of a table say when, who and what; an empty field is guessed from the names usual in the field.

    Attributes:
        time: Stamps. A table without stamps needs `fps`.
        time_unit: S, ms, us, ns; empty: seconds if the median step lies between 0.1 ms and 2 s, else the
            first of ms, us, ns for which it does.
        fps: Frame rate of a table without stamps [Hz], 0 if it has them.
        groups: Columns that together name one recording.
        session: Columns that together name a session; default: `groups` without the last.
        task: What is done, a sentence per row.
    """

    time: str = ""
    time_unit: str = ""
    fps: float = 0.0
    groups: tuple[str, ...] = ()
    session: tuple[str, ...] = ()
    task: str = ""

    def __post_init__(self) -> None:
        if self.time_unit and self.time_unit not in TIME_UNITS:
            raise ValueError(f"time_unit must be one of {', '.join(TIME_UNITS)}, got {self.time_unit!r}")


@dataclass(frozen=True, eq=False)
class Span:
    """One recording in a table: its rows in order, its stamps [s], and what the table says of it, if anything."""

    rows: np.ndarray
    t: np.ndarray
    name: str
    session: str
    task: str


def table_files(source: Path) -> list[Path]:
    """The file itself, or the tables in a folder, sorted.

    Raises:
        FileNotFoundError: Nothing at `source`.
        ValueError: A folder without tables.
    """
    if not source.exists():
        raise FileNotFoundError(f"input {source} does not exist")
    if not source.is_dir():
        return [source]
    files = sorted(path for path in source.iterdir() if path.name.endswith(TABLE_SUFFIXES))
    if not files:
        raise ValueError(
            f"{source} is neither a LeRobot dataset (no meta/info.json) nor a folder of "
            f"{', '.join(TABLE_SUFFIXES)} files"
        )
    return files


def read_table(path: Path) -> pd.DataFrame:
    """One parquet or CSV file with at least one row, or ValueError."""
    table = _read(path)
    if table.empty:
        raise ValueError(f"{path} has no rows")
    return table


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    if path.name.endswith(".parquet"):
        return read_parquet(path)
    if path.name.endswith(TABLE_SUFFIXES):
        try:
            return pd.read_csv(path, sep="\t" if path.suffix == ".tsv" else ",")
        except (ValueError, OSError) as error:  # pandas' own errors are ValueErrors
            raise ValueError(f"{path} cannot be read as text with columns: {error}") from error
    raise ValueError(
        f"{path}: expected {', '.join(TABLE_SUFFIXES)} or a LeRobot dataset folder "
        "(convert zarr to one of these first)"
    )


def read_parquet(path: Path, columns: list[str] | None = None) -> pd.DataFrame:
    """A parquet file, or ValueError with its name."""
    import pandas as pd

    try:
        return pd.read_parquet(path, columns=columns)
    except (ValueError, OSError) as error:  # pyarrow's own errors are one or the other
        raise ValueError(f"{path} cannot be read as parquet: {error}") from error


def numeric(table: pd.DataFrame, names: Sequence[str], where: str) -> np.ndarray:
    """Columns as numbers, (rows, columns), NaN where a cell is empty.

    Raises:
        ValueError: A cell holds something else; names table, column, row and cell.
    """
    import pandas as pd

    found = []
    for name in names:
        values = pd.to_numeric(table[name], errors="coerce").to_numpy(dtype=np.float64)
        wrong = np.flatnonzero(np.isnan(values) & table[name].notna().to_numpy())
        if len(wrong):
            cell = table[name].iloc[wrong[0]]
            raise ValueError(f"{where}: column {name!r} holds {cell!r} in row {wrong[0]}, expected a number")
        found.append(values)
    return np.column_stack(found)


def find_joint_columns(names: Sequence[str], joints: Sequence[str]) -> list[str] | None:
    """One of `names` for each joint, after the first usual way to call them; None if there are none."""
    for form in _JOINTS:
        found = [form.format(name=name, i=number) for number, name in enumerate(joints, 1)]
        if all(name in names for name in found):
            return found
    return None


def guess_one(table: pd.DataFrame, name: str, role: str, where: str) -> str | None:
    """The column for a role ("time", "gripper", "task"): the one asked for, the first usual name, or None.

    Raises:
        ValueError: The one asked for does not exist.
    """
    if name and name not in table.columns:
        raise ValueError(
            f"{where} has no {role} column {name!r}; its columns: {', '.join(map(str, table.columns))}."
            + did_you_mean(name, map(str, table.columns))
        )
    return name or next((usual for usual in _ONE[role] if usual in table.columns), None)


def group_rows(table: pd.DataFrame, groups: tuple[str, ...]) -> list[np.ndarray]:
    """The rows of each recording, in order; one recording where there are no group columns.

    Raises:
        ValueError: A row belongs to no recording.
    """
    if not groups:
        return [np.arange(len(table))]
    missing = [name for name in groups if table[name].isna().any()]
    if missing:
        raise ValueError(f"group column {missing[0]!r} has empty cells; every row must belong to a recording")
    number = table.groupby(list(groups), sort=False).ngroup().to_numpy()
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def existing(table: pd.DataFrame, names: tuple[str, ...], where: str, role: str) -> tuple[str, ...]:
    """`names`, of which every one must be a column, or ValueError."""
    missing = [name for name in names if name not in table.columns]
    if missing:
        raise ValueError(
            f"{where} has no {role} column {missing[0]!r}; its columns: {', '.join(map(str, table.columns))}."
            + did_you_mean(missing[0], map(str, table.columns))
        )
    return tuple(names)


def spans(table: pd.DataFrame, columns: TableColumns, where: str, default_name: str) -> Iterator[Span]:
    """The recordings of a table, cut by its group columns.

    Args:
        table: The table.
        columns: What its columns mean.
        where: How messages call the table.
        default_name: Of a recording, and its session, that no column names.

    Raises:
        ValueError: Columns that do not exist, rows that belong to no recording, no stamps, or stamps that cannot
            be understood.
    """
    groups = existing(table, columns.groups, where, "group") or tuple(
        name for name in GROUPS if name in table.columns
    )
    session = existing(table, columns.session, where, "session") or groups[:-1]
    time, task = _stamps(table, columns, where), guess_one(table, columns.task, "task", where)
    for rows in group_rows(table, groups):
        name = _label(table, groups, rows[0]) or default_name
        yield Span(
            rows=rows,
            t=time[rows],
            name=name,
            session=_label(table, session, rows[0]) or name,
            task="" if task is None else str(table[task].iloc[rows[0]]),
        )


def _label(table: pd.DataFrame, names: tuple[str, ...], row: int) -> str:
    """What the named columns say in a row, such as "person=11/session=1"."""
    return "/".join(f"{name}={table[name].iloc[row]}" for name in names)


def _stamps(table: pd.DataFrame, columns: TableColumns, where: str) -> np.ndarray:
    """Stamps of all rows in seconds (N,); rows counted at the given rate if there are none."""
    import pandas as pd

    name = guess_one(table, columns.time, "time", where)
    if name is None:
        if columns.fps <= 0:
            raise ValueError(
                f"{where} has no time column (looked for the usual names) and no frame rate was given; "
                f"its columns: {', '.join(map(str, table.columns))}"
            )
        return np.arange(len(table)) / columns.fps
    found = table[name]
    present = found.dropna()
    if present.empty:
        raise ValueError(f"{where}: time column {name!r} holds no stamp")
    if pd.api.types.is_datetime64_any_dtype(found):
        return (found - present.iloc[0]).dt.total_seconds().to_numpy()
    if not pd.api.types.is_numeric_dtype(found):
        raise ValueError(f"{where}: time column {name!r} holds {found.dtype}, expected numbers or datetimes")
    # The origin goes first: nanoseconds since 1970 do not fit a float64 to the microsecond.
    values = (found - present.iloc[0]).to_numpy(dtype=np.float64)
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
