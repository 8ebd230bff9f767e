"""Writing joint-space episodes as a LeRobot v3 dataset.

LeRobot's own recorder takes one frame at a time and rewrites the metadata files after every episode,
which is right beside a robot and a hundred times too slow here. This writer lays out the same files from
whole arrays, with LeRobot's own functions for the schema, the metadata files and the aggregation of
statistics.

Frame t of an episode:

    observation.state (measured)          q_t
    observation.ee_pose                   T_base_tool(q_t)      x y z qx qy qz qw, w >= 0
    observation.ee_target                 pose commanded at t   x y z qx qy qz qw, w >= 0
    action (joint command given at t)     with no lag: observation.state of frame t + 1

A dataset in end-effector space, for policies that MimicIK then serves, has the poses (and the gripper) as state
and action instead, and the state once more as observation.environment_state, which LeRobot's low-dimensional
policies ask for.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik import outputs
from lerobot_mimicik.kinematics.arms import ARM_FILE, ArmDescription, arm_of_dataset

POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
GRIPPER_NAME = "gripper.pos"
# Only in datasets whose joints were recorded; in all others made here they were generated or computed.
LOG_FILE = "meta/joint_log.json"
SPACES = ("joints", "ee")
# Only in stress sets: what was asked without what was added, and the nearest pose that the arm can have.
CLEAN_KEY = "observation.ee_target_clean"
CLOSEST_KEY = "observation.ee_target_closest"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)  # those LeRobot stores


@dataclass
class Episode:
    """One episode of T frames, as it goes into a dataset.

    Attributes:
        state: Measured joints [rad], shape (T, dof).
        action: Commanded joints [rad], shape (T, dof).
        ee_pose: Tool pose of the measured joints in the base frame, xyzw, shape (T, 7).
        ee_target: Tool pose commanded, in the base frame, xyzw, shape (T, 7).
        task: What is being done, a sentence.
        session: Who recorded it and when; splits never cut through a session.
        gripper: Measured and commanded gripper, shape (T, 2), or None for an arm without one.
        ee_target_clean: `ee_target` without what was added to it (tremor), shape (T, 7); None: no such column.
        ee_target_closest: The pose nearest to `ee_target` that the arm can have, shape (T, 7); None: no such column.
    """

    state: np.ndarray
    action: np.ndarray
    ee_pose: np.ndarray
    ee_target: np.ndarray
    task: str
    session: str
    gripper: np.ndarray | None = None
    ee_target_clean: np.ndarray | None = None
    ee_target_closest: np.ndarray | None = None

    def extra_poses(self) -> dict[str, np.ndarray]:
        """The pose columns (T, 7) beyond those that every dataset has, by their feature's name."""
        found = {CLEAN_KEY: self.ee_target_clean, CLOSEST_KEY: self.ee_target_closest}
        return {key: poses for key, poses in found.items() if poses is not None}

    def __len__(self) -> int:
        return len(self.state)


def dataset_features(
    joint_names: Iterable[str], gripper: bool, space: str = "joints", extra_poses: Iterable[str] = ()
) -> dict[str, dict[str, Any]]:
    """LeRobot features of a dataset in one of `SPACES` (without those LeRobot adds itself).

    `extra_poses` are names of further pose columns, for a dataset in joint space.
    """
    if space not in SPACES:
        raise ValueError(f"space={space!r}: expected one of {', '.join(SPACES)}")
    joints = [f"{name}.pos" for name in joint_names] + ([GRIPPER_NAME] if gripper else [])

    def vector(names: list[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    if space == "ee":
        poses = [f"ee.{name}.pos" for name in POSE_NAMES] + ([f"ee.{GRIPPER_NAME}"] if gripper else [])
        keys = ("observation.state", "observation.environment_state", "action")
        return {key: vector(list(poses)) for key in keys}
    return {
        "observation.state": vector(joints),
        "observation.ee_pose": vector(list(POSE_NAMES)),
        "observation.ee_target": vector(list(POSE_NAMES)),
        **{key: vector(list(POSE_NAMES)) for key in extra_poses},
        "action": vector(list(joints)),
    }


def write_dataset(
    root: str | Path,
    repo_id: str,
    episodes: Iterable[Episode],
    description: ArmDescription,
    fps: int = 20,
    robot_type: str | None = None,
    overwrite: bool = False,
    space: str = "joints",
    beside: Mapping[str, str] | None = None,
) -> dict[str, int]:
    """Write `episodes` as a LeRobot v3 dataset that `LeRobotDataset(repo_id, root=root)` opens.

    Args:
        root: Folder of the dataset; must not exist or be empty unless `overwrite`. It appears only when the
            dataset is complete.
        repo_id: Name of the dataset ("local/train"); recorded nowhere, used in messages.
        episodes: Consumed once, in order.
        description: The arm, stored in meta/arm.json.
        fps: Frames per second.
        robot_type: LeRobot's free-form robot name, stored in meta/info.json.
        overwrite: Replace a dataset that is already at `root`, if this project made it and nothing else is in it;
            see `outputs`.
        space: One of `SPACES`, that of state and action.
        beside: Text of further files by their paths below `root`.

    Returns:
        {"episodes": ..., "frames": ...}.

    Raises:
        FileExistsError: `root` or `root`.writing holds something that may not be replaced.
        ValueError: No episode, or an episode with inconsistent shapes or non-finite numbers.
    """
    outputs.check_new(root, "dataset", overwrite)
    with outputs.building(root, "dataset") as new:
        totals = _write_files(new, repo_id, iter(episodes), description, fps, robot_type, space)
        for name, text in (beside or {}).items():
            (new / name).write_text(text)
    return totals


def read_arm_json(root: str | Path) -> ArmDescription:
    """The arm a dataset was written for, from its meta/arm.json.

    Raises:
        FileNotFoundError: The dataset has no such file (it was not written by this project).
        ValueError: The file is damaged.
    """
    description = arm_of_dataset(root)
    if description is None:
        raise FileNotFoundError(
            f"{Path(root) / ARM_FILE} is missing: the dataset does not say for which arm it is"
        )
    return description


def import_lerobot() -> None:
    """Import what `write_dataset` needs of LeRobot: seconds, better spent while other processes work."""
    import lerobot.datasets.compute_stats
    import lerobot.datasets.dataset_metadata  # noqa: F401


def episode_statistics(columns: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Per-feature statistics of one episode under the keys LeRobot stores.

    Same as LeRobot's `compute_episode_stats` except that quantiles are exact instead of read off a
    5,000-bin histogram, which also makes it fifty times faster on short episodes.
    """
    # All features side by side: one sort and one reduction instead of one per feature.
    widths = {key: int(np.prod(column.shape[1:], dtype=int)) for key, column in columns.items()}
    rows = np.concatenate(
        [column.reshape(-1, widths[key]).astype(np.float64) for key, column in columns.items()], axis=1
    )
    count = len(rows)
    ordered = np.sort(rows, axis=0)
    position = np.array(_QUANTILES) * (count - 1)
    below = np.floor(position).astype(int)
    above = np.minimum(below + 1, count - 1)
    quantiles = ordered[below] + (position - below)[:, None] * (ordered[above] - ordered[below])
    mean = rows.mean(axis=0)
    summary = {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": mean,
        "std": np.sqrt(((rows - mean) ** 2).mean(axis=0)),
        **{f"q{round(100 * level):02d}": row for level, row in zip(_QUANTILES, quantiles, strict=True)},
    }
    statistics: dict[str, dict[str, np.ndarray]] = {}
    start = 0
    for key, width in widths.items():
        statistics[key] = {name: row[start : start + width] for name, row in summary.items()}
        statistics[key]["count"] = np.array([count])
        start += width
    return statistics


def _write_files(
    root: Path,
    repo_id: str,
    episodes: Iterator[Episode],
    description: ArmDescription,
    fps: int,
    robot_type: str | None,
    space: str,
) -> dict[str, int]:
    # LeRobot's dataset package takes seconds to import; worker processes use Episode without paying for it.
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq
    from lerobot.datasets.compute_stats import aggregate_stats
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
    from lerobot.datasets.feature_utils import create_empty_dataset_info, get_hf_features_from_features
    from lerobot.datasets.io_utils import write_info, write_stats, write_tasks
    from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, update_chunk_file_indices
    from lerobot.utils.constants import DEFAULT_FEATURES

    first = next(episodes, None)
    if first is None:
        raise ValueError(f"dataset {repo_id}: there is no episode to write")
    features = {
        **dataset_features(description.joint_names, first.gripper is not None, space, first.extra_poses()),
        **{key: dict(value) for key, value in DEFAULT_FEATURES.items()},
    }
    info = create_empty_dataset_info(CODEBASE_VERSION, fps, features, use_videos=False, robot_type=robot_type)
    schema = get_hf_features_from_features(features).arrow_schema
    tasks: dict[str, int] = {}
    records: list[dict[str, Any]] = []
    statistics: list[dict[str, dict[str, np.ndarray]]] = []
    chunk = file = frames = 0
    # Float32 rows do not compress: the size of a file is known before it is written.
    frames_per_file = max(1, int(info.data_files_size_in_mb * 2**20 / _row_bytes(features)))
    frames_in_file = 0
    parquet: pq.ParquetWriter | None = None
    try:
        for index, episode in enumerate(itertools.chain([first], episodes)):
            where = f"dataset {repo_id}, episode {index} (session {episode.session!r})"
            columns = _columns(episode, len(description.joint_names), first.gripper is not None, where)
            if space == "ee":
                columns = _in_ee_space(columns, len(description.joint_names))
            length = len(episode)
            task_index = tasks.setdefault(episode.task, len(tasks))
            columns |= {
                "timestamp": np.arange(length, dtype=np.float32) / np.float32(fps),
                "frame_index": np.arange(length),
                "episode_index": np.full(length, index),
                "index": np.arange(frames, frames + length),
                "task_index": np.full(length, task_index),
            }
            if parquet is not None and frames_in_file + length > frames_per_file:
                parquet.close()
                parquet = None
                chunk, file = update_chunk_file_indices(chunk, file, info.chunks_size)
                frames_in_file = 0
            if parquet is None:
                path = root / info.data_path.format(chunk_index=chunk, file_index=file)
                path.parent.mkdir(parents=True, exist_ok=True)
                parquet = pq.ParquetWriter(path, schema=schema, compression="snappy", use_dictionary=False)
            # One row group per episode, as LeRobot's recorder writes them.
            parquet.write_table(_table(pa, schema, columns))
            statistics.append(episode_statistics(columns))
            records.append(
                {
                    "episode_index": index,
                    "tasks": [episode.task],
                    "length": length,
                    "session": episode.session,
                    "data/chunk_index": chunk,
                    "data/file_index": file,
                    "dataset_from_index": frames,
                    "dataset_to_index": frames + length,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                }
            )
            frames += length
            frames_in_file += length
    finally:
        if parquet is not None:
            parquet.close()

    for record, entry in zip(records, statistics, strict=True):
        for key, feature in entry.items():
            record.update({f"stats/{key}/{name}": value.tolist() for name, value in feature.items()})
    path = root / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(records), path, compression="snappy")
    write_tasks(
        pd.DataFrame({"task_index": list(tasks.values())}, index=pd.Index(list(tasks), name="task")), root
    )
    info.total_episodes, info.total_frames, info.total_tasks = len(records), frames, len(tasks)
    info.splits = {"train": f"0:{len(records)}"}
    write_info(info, root)
    write_stats(aggregate_stats(statistics), root)
    (root / ARM_FILE).write_text(description.to_json() + "\n")
    return {"episodes": len(records), "frames": frames}


def _row_bytes(features: dict[str, dict[str, Any]]) -> int:
    return sum(np.dtype(ft["dtype"]).itemsize * int(np.prod(ft["shape"])) for ft in features.values())


def _columns(episode: Episode, dof: int, gripper: bool, where: str) -> dict[str, np.ndarray]:
    """The episode's own columns as float32, checked for shape, finiteness and unit quaternions."""
    length = len(episode)
    if length == 0:
        raise ValueError(f"{where} has no frame")
    expected = {"state": dof, "action": dof, "ee_pose": 7, "ee_target": 7}
    if gripper != (episode.gripper is not None):
        raise ValueError(
            f"{where}: the first episode has {'a' if gripper else 'no'} gripper, this one differs"
        )
    if gripper:
        expected["gripper"] = 2
    for name, width in expected.items():
        values = np.asarray(getattr(episode, name))
        if values.shape != (length, width):
            raise ValueError(f"{where}: {name} must have shape {(length, width)}, got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError(
                f"{where}: {name} is not finite at frame {int(np.argmin(np.isfinite(values).all(1)))}"
            )
    joints = {"observation.state": episode.state, "action": episode.action}
    if episode.gripper is not None:
        joints = {
            key: np.column_stack([values, episode.gripper[:, column]])
            for column, (key, values) in enumerate(joints.items())
        }
    poses = {
        "observation.ee_pose": episode.ee_pose,
        "observation.ee_target": episode.ee_target,
        **episode.extra_poses(),
    }
    for key, values in episode.extra_poses().items():
        if values.shape != (length, 7) or not np.isfinite(values).all():
            raise ValueError(
                f"{where}: {key} must be finite and have shape {(length, 7)}, got {values.shape}"
            )
    columns = {}
    for key, values in poses.items():
        norm = np.linalg.norm(values[:, 3:], axis=1)
        if np.abs(norm - 1).max() > 1e-3:
            raise ValueError(f"{where}: {key} has a quaternion of norm {norm[np.abs(norm - 1).argmax()]:.4f}")
        sign = np.where(values[:, 6:] < 0, -1.0, 1.0)
        columns[key] = np.concatenate([values[:, :3], values[:, 3:] * sign], axis=1)
    ordered = {
        "observation.state": joints["observation.state"],
        **columns,
        "action": joints["action"],
    }
    return {key: np.ascontiguousarray(values, dtype=np.float32) for key, values in ordered.items()}


def _in_ee_space(columns: dict[str, np.ndarray], dof: int) -> dict[str, np.ndarray]:
    """The columns of a dataset in end-effector space from those of one in joint space."""

    def with_gripper(pose: str, joints: str) -> np.ndarray:
        return np.concatenate([columns[pose], columns[joints][:, dof:]], axis=1)

    state = with_gripper("observation.ee_pose", "observation.state")
    action = with_gripper("observation.ee_target", "action")
    return {"observation.state": state, "observation.environment_state": state, "action": action}


def _table(pa: Any, schema: Any, columns: dict[str, np.ndarray]) -> Any:
    arrays = []
    for field in schema:
        values = columns[field.name]
        if pa.types.is_fixed_size_list(field.type):
            arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), field.type.list_size))
        else:
            arrays.append(pa.array(values, type=field.type))
    return pa.Table.from_arrays(arrays, schema=schema)
