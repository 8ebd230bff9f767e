"""Recorded trajectories to evaluate on, read from a LeRobot dataset."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_mimicik.columns import flat_names, joint_columns
from lerobot_mimicik.data.writer import CLEAN_KEY, CLOSEST_KEY
from lerobot_mimicik.kinematics.arms import ARM_FILE, arm_of_dataset
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.plausibility import why_not_same_arm
from lerobot_mimicik.kinematics.recorded import Column, check_recorded
from lerobot_mimicik.solvers.base import Array

if TYPE_CHECKING:
    from lerobot_mimicik.configuration_learned import LearnedIKConfig
    from lerobot_mimicik.kinematics.arms import ArmDescription

_STATE, _ACTION = "observation.state", "action"
_STRESS = (CLEAN_KEY, CLOSEST_KEY)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded trajectory of T frames.

    Attributes:
        index: Its episode number in the dataset.
        q: Measured joints, (T, dof), rad.
        target: `T_base_tool` commanded at each frame, (T, 7), x y z (m) qx qy qz qw.
        clean: The same without what a stress set added to it, (T, 7); None where the dataset does not say.
        closest: The pose nearest to the target that the arm can have, (T, 7); None where the dataset does not say.
        arm: The arm that they are of; None where that is not known.
    """

    index: int
    q: Array
    target: Array
    clean: Array | None = None
    closest: Array | None = None
    arm: ArmDescription | None = None

    def __post_init__(self) -> None:
        if self.q.ndim != 2 or self.target.shape != (len(self.q), 7) or not len(self.q):
            raise ValueError(
                f"Trajectory {self.index}: expected q (T, dof) and target (T, 7) with T > 0, "
                f"got {self.q.shape} and {self.target.shape}."
            )

    def __len__(self) -> int:
        return len(self.q)

    def first(self, frames: int) -> Trajectory:
        """Its first so many frames."""
        clean, closest = (None if poses is None else poses[:frames] for poses in (self.clean, self.closest))
        return Trajectory(self.index, self.q[:frames], self.target[:frames], clean, closest, self.arm)


@dataclass(frozen=True, eq=False)
class TrajectorySet:
    """The trajectories of one dataset.

    Attributes:
        name: How tables call the dataset.
        root: Its folder.
        fps: Frames per second.
        trajectories: At least one.
    """

    name: str
    root: Path
    fps: float
    trajectories: tuple[Trajectory, ...]

    @property
    def frames(self) -> int:
        """Number of frames of all trajectories."""
        return sum(map(len, self.trajectories))


@dataclass(frozen=True)
class Layout:
    """Where a dataset keeps joints and targets; the same words as in the policy's configuration.

    Attributes:
        joint_units: "rad" or "deg".
        target: Target joints where no pose is recorded: "action", or the "next_state".
        target_pose_key: Column of the target pose; FK of the target joints where a dataset lacks it.
        state_joint_names: Elements of the state that are the joints, in joint order; None finds them by name.
        action_joint_names: The same for the action; None is as the state.
        any_arm: The user names the arm, whatever the dataset says.
    """

    joint_units: str = "rad"
    target: str = "action"
    target_pose_key: str = "observation.ee_target"
    state_joint_names: Sequence[str] | None = None
    action_joint_names: Sequence[str] | None = None
    any_arm: bool = False

    @classmethod
    def of_policy(cls, config: LearnedIKConfig) -> Layout:
        """What a policy was trained to expect."""
        return cls(
            joint_units=config.joint_units,
            target=config.target,
            target_pose_key=config.target_pose_key,
            state_joint_names=config.state_joint_names,
            action_joint_names=config.action_joint_names,
        )


def load_trajectories(
    root: str | Path,
    arm: SerialArm,
    layout: Layout | None = None,
    episodes: Iterable[int] | None = None,
    name: str | None = None,
) -> TrajectorySet:
    """Read a LeRobot v3 dataset from a folder.

    Args:
        root: The dataset's folder.
        arm: Whose joints are read, and whose FK gives the targets where no pose column does; float64.
        layout: Where the dataset keeps what; None is this project's own layout.
        episodes: Episode numbers to read; None reads all.
        name: The set's name; None is the folder's.

    Raises:
        FileNotFoundError: If `root` is no LeRobot dataset.
        ValueError: If columns or episodes are missing (the message lists what exists), or the numbers cannot be
            this arm's: another arm's dataset, another unit, not finite.
    """
    from lerobot.datasets import LeRobotDatasetMetadata

    root, layout = Path(root), layout or Layout()
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(
            f"{root} is not a LeRobot dataset: {root / 'meta/info.json'} does not exist."
            + _nearby_datasets(root)
        )
    own = None if layout.any_arm else arm_of_dataset(root)
    reason = None if own is None else why_not_same_arm(arm.description, own)
    if reason is not None:
        raise ValueError(f"{root} was recorded with another arm ({ARM_FILE}) than it is read for: {reason}.")
    meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    columns = _read_columns(root, _wanted(meta.features, layout))
    joints = _joints(_STATE, columns, meta.features, arm, layout.state_joint_names, layout.joint_units)
    recorded = (
        columns[layout.target_pose_key].astype(np.float64) if layout.target_pose_key in columns else None
    )
    commands = None
    if recorded is None and layout.target == "action":
        names = layout.action_joint_names or layout.state_joint_names
        commands = _joints(_ACTION, columns, meta.features, arm, names, layout.joint_units)
    chosen = _episode_rows(columns["episode_index"], episodes, root)
    _check(
        arm, layout, root, [rows for _, rows in chosen], columns["episode_index"], joints, commands, recorded
    )
    if recorded is not None:
        pose = recorded[:, :7]
    else:
        pose = _fk(arm, np.roll(joints, -1, axis=0) if commands is None else commands)
    drop_last = recorded is None and layout.target == "next_state"

    trajectories = []
    for index, rows in chosen:
        # The last frame of an episode has no next state to aim at.
        rows = slice(rows.start, rows.stop - 1) if drop_last else rows
        if rows.stop > rows.start:
            clean, closest = (columns[k][rows].astype(np.float64) if k in columns else None for k in _STRESS)
            trajectories.append(Trajectory(index, joints[rows], pose[rows], clean, closest, arm.description))
    if not trajectories:
        raise ValueError(f"{root} has no episode with a frame to evaluate.")
    return TrajectorySet(name or root.name, root, float(meta.fps), tuple(trajectories))


def first_seconds(
    trajectories: TrajectorySet, of_each: float = math.inf, in_all: float = math.inf
) -> TrajectorySet:
    """The beginning of each trajectory, and of these the first ones that fill a time in all.

    Args:
        trajectories: The whole set.
        of_each: Longest that a trajectory may be, s.
        in_all: Longest that all of them may be together, s; the last one is cut to fit.

    Raises:
        ValueError: If a time is shorter than a frame.
    """
    frames_each, left = of_each * trajectories.fps, in_all * trajectories.fps
    if frames_each < 1 or left < 1:
        raise ValueError(f"{min(of_each, in_all):g} s is less than a frame at {trajectories.fps:g} fps.")
    kept: list[Trajectory] = []
    for one in trajectories.trajectories:
        length = int(min(len(one), frames_each, left))
        if not length:
            break
        kept.append(one.first(length))
        left -= length
    return replace(trajectories, trajectories=tuple(kept))


def distinct_names(roots: Sequence[str | Path]) -> list[str]:
    """The last part of each path, or as many parts as it takes to tell the paths apart."""
    parts = [Path(root).resolve().parts for root in roots]
    names = []
    for own in parts:
        others = [other for other in parts if other != own]
        depth = 1
        while depth < len(own) and any(other[-depth:] == own[-depth:] for other in others):
            depth += 1
        names.append("/".join(own[-depth:]))
    return names


def _wanted(features: dict[str, dict[str, Any]], layout: Layout) -> list[str]:
    """Columns to read: the state, and the target pose or what it is computed from."""
    source = _ACTION if layout.target == "action" else _STATE
    target = layout.target_pose_key if layout.target_pose_key in features else source
    missing = [key for key in (_STATE, target) if key not in features]
    if missing:
        raise ValueError(
            f"The dataset has no column {', '.join(missing)}; it has {', '.join(sorted(features))}."
        )
    return sorted({_STATE, target, "episode_index", "index", *(key for key in _STRESS if key in features)})


def _read_columns(root: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Whole columns, in the order of the frames: (N,) for numbers, (N, d) for vectors."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise FileNotFoundError(f"{root} has no data: {root / 'data'} holds no parquet file.")
    table = pa.concat_tables([pq.read_table(file, columns=names) for file in files]).sort_by("index")
    columns = {}
    for name in names:
        column = table[name].combine_chunks()
        if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
            columns[name] = column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
        else:
            columns[name] = column.to_numpy(zero_copy_only=False)
    return columns


def _joints(
    key: str,
    columns: dict[str, np.ndarray],
    features: dict[str, dict[str, Any]],
    arm: SerialArm,
    requested: Sequence[str] | None,
    units: str,
) -> Array:
    """The arm's joints out of a column, (N, dof), rad."""
    names = flat_names(features[key].get("names"))
    picked = joint_columns(key, names, columns[key].shape[1], arm.joint_names, requested)
    joints = columns[key][:, picked].astype(np.float64)
    return np.radians(joints) if units == "deg" else joints


def _check(
    arm: SerialArm,
    layout: Layout,
    root: Path,
    chosen: list[slice],
    episode: NDArray[np.integer],
    joints: Array,
    commands: Array | None,
    poses: Array | None,
) -> None:
    """Refuse a dataset that cannot be of this arm, as far as the chosen episodes tell."""
    if not chosen:
        return

    def column(name: str, values: Array | None, elements: Sequence[str]) -> Column | None:
        if values is None:
            return None
        return Column(name, np.concatenate([values[rows, : len(elements)] for rows in chosen]), elements)

    measured = column(_STATE, joints, arm.joint_names)
    assert measured is not None
    check_recorded(
        arm.description,
        np.concatenate([episode[rows] for rows in chosen]),
        measured,
        column(_ACTION, commands, arm.joint_names),
        target_pose=column(layout.target_pose_key, poses, ("x", "y", "z", "qx", "qy", "qz", "qw")),
        where=str(root),
        joints_remedy="--joint_units=deg reads the dataset in degrees, in training --policy.joint_units=deg."
        if layout.joint_units == "rad"
        else "--joint_units=rad reads the dataset in radians, in training --policy.joint_units=rad.",
    )


def _fk(arm: SerialArm, q: Array) -> Array:
    return arm.forward(torch.from_numpy(q)).numpy()


def _episode_rows(
    episode_index: np.ndarray, wanted: Iterable[int] | None, root: Path
) -> list[tuple[int, slice]]:
    """(episode, rows) for each wanted episode; frames of an episode are contiguous in a LeRobot dataset."""
    starts = np.flatnonzero(np.diff(episode_index, prepend=-1))
    stops = [*starts[1:], len(episode_index)]
    found = {
        int(episode_index[start]): slice(int(start), int(stop))
        for start, stop in zip(starts, stops, strict=True)
    }
    chosen = list(found) if wanted is None else list(wanted)
    missing = [index for index in chosen if index not in found]
    if missing:
        raise ValueError(f"{root} has no episode {missing}; it has {min(found)} to {max(found)}.")
    return [(index, found[index]) for index in chosen]


def _nearby_datasets(root: Path) -> str:
    """A hint where the folder above or the folder itself holds datasets."""
    found = sorted(
        {file.parent.parent for base in (root, root.parent) for file in base.glob("*/meta/info.json")}
    )
    return f" Datasets nearby: {', '.join(map(str, found))}." if found else ""
