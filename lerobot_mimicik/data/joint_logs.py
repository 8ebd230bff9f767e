"""Logs of an arm's measured (and commanded) joints as a dataset: nothing is computed but the poses, by FK.

A log comes at the arm's own rate, often hundreds of hertz, and becomes frames at the rate of control: the state is
what was measured at a frame's time, the action what was measured at the next, or what was commanded for it. Commands
are used only where columns are named: an arm may lag them by many frames (an AIRBOT Play that is streamed positions: 0.2
s), and then they are further away than a step of control.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_mimicik import outputs
from lerobot_mimicik.data.joint_readings import Mended, pieces, usable_rows
from lerobot_mimicik.data.lerobot_tables import is_lerobot, joint_table
from lerobot_mimicik.data.tables import (
    TableColumns,
    existing,
    find_joint_columns,
    guess_one,
    numeric,
    read_table,
    spans,
    table_files,
)
from lerobot_mimicik.data.writer import LOG_FILE, Episode, write_dataset
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain


@dataclass(frozen=True)
class LogColumns(TableColumns):
    """Which columns of a log mean what; an empty field but `commands` is guessed from usual names.

    Attributes:
        joints: Measured joints, in the arm's order.
        commands: Commanded joints; empty: each frame aims at the next measured joints.
        units: "rad" or "deg", of joints that turn; those that slide are in m.
        gripper: Its position, passed through; commands of it are the next ones measured.
    """

    joints: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    units: str = "rad"
    gripper: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.units not in ("rad", "deg"):
            raise ValueError(f"joint units must be rad or deg, got {self.units!r}")


@dataclass(frozen=True)
class LogSummary:
    """What was written: the dataset's folder, its episodes and frames, and what was done to the readings."""

    root: Path
    episodes: int
    frames: int
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        first = f"{self.episodes} episodes, {self.frames} frames of recorded joints: {self.root}"
        return "\n  ".join([first, *self.notes])


def write_joint_logs(
    source: str | Path,
    root: str | Path,
    description: ArmDescription,
    columns: LogColumns | None = None,
    fps: int = 20,
    max_gap: float = 0.2,
    min_duration: float = 1.0,
    task: str = "recorded motion",
    robot_type: str | None = None,
    overwrite: bool = False,
    space: str = "joints",
) -> LogSummary:
    """Write the logs of a file, of a folder's files or of a LeRobot dataset as one LeRobot dataset.

    Args:
        source: Parquet or CSV, or a LeRobot dataset with the joints in its state.
        root: The dataset's folder.
        description: The arm.
        columns: Where the logs keep what.
        fps: Frames per second of the dataset.
        max_gap: Longer holes in the stamps cut a recording in two [s].
        min_duration: Shorter pieces are left out [s].
        task: Sentence for logs that have none.
        robot_type, overwrite, space: See `write_dataset`.

    Raises:
        FileNotFoundError: Nothing at `source`.
        FileExistsError: `root` holds something that may not be replaced.
        ValueError: The source is also the output; columns that are missing, numbers that cannot be the arm's joints,
            or no piece that is long enough.
    """
    columns = columns or LogColumns()
    outputs.check_new(root, "dataset", overwrite, [source])
    files = [Path(source)] if is_lerobot(Path(source)) else table_files(Path(source))
    mended = Mended()
    episodes = [
        episode
        for path in files
        for episode in _episodes(path, description, columns, fps, max_gap, min_duration, task, mended)
    ]
    if not episodes:
        raise ValueError(
            "; ".join(
                [
                    f"{source} holds no recording of at least {min_duration:g} s without a hole of {max_gap:g} s",
                    *mended.lines(),
                ]
            )
        )
    notes = mended.lines()
    if columns.units == "deg" and max(np.abs(episode.state).max() for episode in episodes) < math.radians(7):
        notes.append("no joint is ever 7 deg from zero: are the readings in rad? (--columns.joint_units)")
    about = {"joints": "recorded", "files": [path.name for path in files], "mended": asdict(mended)}
    totals = write_dataset(
        root,
        f"local/{Path(root).name}",
        episodes,
        description,
        fps,
        robot_type,
        overwrite,
        space,
        {LOG_FILE: json.dumps(about, indent=2) + "\n"},
    )
    return LogSummary(Path(root), **totals, notes=tuple(notes))


def _episodes(
    path: Path,
    description: ArmDescription,
    columns: LogColumns,
    fps: int,
    max_gap: float,
    min_duration: float,
    task: str,
    mended: Mended,
) -> Iterator[Episode]:
    table, where = joint_table(path) if is_lerobot(path) else read_table(path), str(path)
    chain = array_chain(description)
    measured = _joint_columns(table, columns.joints, description, where)
    commanded = _joint_columns(table, columns.commands, description, where) if columns.commands else measured
    turn = math.pi / 180 if columns.units == "deg" else 1.0
    units = np.array([1.0 if joint.type == "prismatic" else turn for joint in description.joints()])
    usable, *clipped = usable_rows(
        description,
        numeric(table, measured, where) * units,
        numeric(table, commanded, where) * units,
        where,
        mended,
    )
    joints = np.hstack(clipped)
    gripper = guess_one(table, columns.gripper, "gripper", where)
    opening = None if gripper is None else numeric(table, [gripper], where)
    if opening is not None:
        usable = usable & np.isfinite(opening[:, 0])
    for span in spans(table, columns, where, path.name):
        for piece in pieces(span.t, joints[span.rows], usable[span.rows], max_gap, fps, mended):
            t, rows = span.t[piece], span.rows[piece]
            if t[-1] - t[0] < max(min_duration, 2 / fps):
                mended.short += float(t[-1] - t[0])
                continue
            state, action = np.hsplit(_resampled(t, joints[rows], fps), 2)
            width = None if opening is None else _resampled(t, opening[rows], fps)
            # A frame's action is what holds at the next.
            state, action = state[:-1], action[1:]
            yield Episode(
                state=state,
                action=action,
                ee_pose=chain.pose(state),
                ee_target=chain.pose(action),
                task=span.task or task,
                session=span.session,
                gripper=None if width is None else np.hstack([width[:-1], width[1:]]),
            )


def _joint_columns(
    table: pd.DataFrame, asked: tuple[str, ...], description: ArmDescription, where: str
) -> list[str]:
    """One column for each joint: those asked for, else the first usual way to call them."""
    names = description.joint_names
    if asked:
        if len(asked) != len(names):
            raise ValueError(f"{len(asked)} columns given for {len(names)} joints ({', '.join(names)})")
        return list(existing(table, asked, where, "joint"))
    found = find_joint_columns(table.columns, names)
    if found is not None:
        return found
    raise ValueError(
        f"{where} has no columns for the joints {', '.join(names)} (looked for them by name and for q1, q2, "
        f"...); its columns: {', '.join(map(str, table.columns))}"
    )


def _resampled(time: np.ndarray, values: np.ndarray, fps: int) -> np.ndarray:
    """Values (N, d) at the times of frames, (T, d)."""
    # Stamps of single precision are short of a frame by less than 1 % of it.
    grid = time[0] + np.arange(int((time[-1] - time[0]) * fps + 0.01) + 1) / fps
    return np.column_stack([np.interp(grid, time, column) for column in values.T])
