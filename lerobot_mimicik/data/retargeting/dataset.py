"""From end-effector recordings to a LeRobot dataset: read, retarget in parallel, write, report.

The recordings are cut into batches whose size does not depend on the number of workers; every batch becomes a
part on disk (see `parts`). The dataset is put together from the parts in order, so that it is the same for
any number of workers and whether or not the run was interrupted.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_mimicik import outputs
from lerobot_mimicik.data.retargeting.parts import PartStore, load_outcomes, manifest_of, save_outcomes
from lerobot_mimicik.data.retargeting.recorded_units import check_recordings
from lerobot_mimicik.data.retargeting.recordings import Recording, SourceColumns, load_recordings
from lerobot_mimicik.data.retargeting.report import RetargetSummary, retarget_report
from lerobot_mimicik.data.retargeting.retarget import DROPPED, Outcome, Retargeter, RetargetOptions
from lerobot_mimicik.data.workers import worker_pool
from lerobot_mimicik.data.writer import Episode, import_lerobot, write_dataset
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.trajectory_ik import forward

REPORT_FILE = "meta/retarget_report.json"
_BATCH = 128
_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class JobOptions:
    """How the work is done and what is written.

    Attributes:
        workers: Processes; 0 works in this one.
        resume: Continue an interrupted run of the same settings.
        overwrite: Replace a dataset that is already there.
        test_share: Share of the sessions that go to a dataset of their own; 0: one dataset.
        lag_s: Time constant with which the measured joints follow the command [s]; 0: they are there a frame
            later.
        task: Sentence for recordings that have none.
        robot_type: LeRobot's free-form robot name.
        progress: Show a progress bar.
        limit: Use only the first so many recordings; 0: all.
        space: Of state and action, one of `writer.SPACES`.
    """

    workers: int = 2
    resume: bool = False
    overwrite: bool = False
    test_share: float = 0.0
    lag_s: float = 0.0
    task: str = "follow the recorded hand motion"
    robot_type: str | None = None
    progress: bool = True
    limit: int = 0
    space: str = "joints"

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ValueError(f"workers must not be negative, got {self.workers}")
        if not 0 <= self.test_share < 1:
            raise ValueError(f"test_share must be in [0, 1), got {self.test_share}")
        if self.lag_s < 0:
            raise ValueError(f"lag_s must not be negative, got {self.lag_s}")


def retarget_dataset(
    source: str | Path,
    output: str | Path,
    description: ArmDescription,
    options: RetargetOptions | None = None,
    columns: SourceColumns | None = None,
    job: JobOptions | None = None,
) -> RetargetSummary:
    """Retarget all recordings of a source to an arm and write them as LeRobot datasets.

    Args:
        source: Parquet, CSV, a folder of them, or a LeRobot dataset with poses; see `recordings`.
        output: Folder of the dataset; with a test share its two splits "train" and "test".
        description: The arm.
        options: How recordings are made to fit.
        columns: Which columns mean what, where the names are unusual.
        job: Workers, resuming, splits, lag.

    Raises:
        FileExistsError: `output`, `output`.parts or `output`.writing holds something that may not be replaced.
        ValueError: The source is also the output, columns that are not understood, a resumed run with other
            settings, recordings in other units than they were read in, or nothing left to write.
    """
    started = time.monotonic()
    options, columns, job = options or RetargetOptions(), columns or SourceColumns(), job or JobOptions()
    output = Path(output)
    roots = {"train": output / "train", "test": output / "test"} if job.test_share > 0 else {"all": output}
    for root in roots.values():
        # What may be there is known only when a resumed run is found.
        outputs.check_new(root, "dataset", job.overwrite or job.resume, [source])
    recordings = load_recordings(source, columns, description.joint_names)
    check_recordings(recordings, description, options.cleaning.max_speed, columns.position_unit, str(source))
    recordings = recordings[: job.limit] if job.limit else recordings
    manifest = manifest_of(
        recordings=_fingerprint(recordings),
        arm=description,
        options=options,
        columns=columns,
        batch=_BATCH,
        output={"test_share": job.test_share, "lag_s": job.lag_s, "task": job.task, "space": job.space},
    )
    settings = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    store_folder = output.resolve().with_name(output.resolve().name + ".parts")
    resuming = job.resume and store_folder.exists()
    finished = next(iter(roots.values())) / REPORT_FILE
    if job.resume and not resuming and finished.is_file():
        report = json.loads(finished.read_text())
        if report.get("settings") == settings:
            return RetargetSummary(roots, report)
    for root in roots.values():
        # A run interrupted while writing may have left one of two splits.
        outputs.check_new(root, "dataset", job.overwrite or resuming, [source])
    store = PartStore(store_folder, manifest, job.resume)
    count = -(-len(recordings) // _BATCH)
    _work_off(recordings, store, store.missing(count), description, options, job)
    outcomes = [outcome for number in range(count) for outcome in load_outcomes(store.path(number))]
    usable = [outcome for outcome in outcomes if outcome.status != DROPPED]
    if not usable:
        store.remove()
        reasons = Counter(outcome.reason for outcome in outcomes)
        raise ValueError(f"none of the {len(outcomes)} recordings of {source} could be used: {dict(reasons)}")
    test_sessions = _test_sessions(usable, job.test_share, options.seed)
    frames = 0
    for split, root in roots.items():
        chosen = [o for o in usable if split == "all" or (o.session in test_sessions) == (split == "test")]
        episodes = _episodes(chosen, description, options.cleaning.fps, job)
        frames += write_dataset(
            root,
            f"local/{root.name}",
            episodes,
            description,
            options.cleaning.fps,
            job.robot_type,
            overwrite=job.overwrite or resuming,
            space=job.space,
        )["frames"]
    report = retarget_report(source, outcomes, description, options)
    seconds = time.monotonic() - started
    report |= {
        "frames": frames,
        "seconds": round(seconds, 2),
        "frames_per_second": round(frames / seconds, 1),
        "test_sessions": sorted(test_sessions),
        "settings": settings,
    }
    for root in roots.values():
        (root / REPORT_FILE).write_text(json.dumps(report, indent=1) + "\n")
    store.remove()
    return RetargetSummary(roots, report)


def follow_command(q: np.ndarray, lag_s: float, fps: float) -> np.ndarray:
    """Measured joints of an arm that follows commands (T, dof) as a first-order lag of time constant `lag_s`.

    The arm starts at the first command, and command t acts from frame t - 1 to frame t: without lag the
    result is `q` itself.
    """
    if lag_s == 0:
        return q.copy()
    share = 1.0 - np.exp(-1.0 / (lag_s * fps))
    measured = np.empty_like(q)
    measured[0] = q[0]
    for frame in range(1, len(q)):
        measured[frame] = measured[frame - 1] + share * (q[frame] - measured[frame - 1])
    return measured


def _episodes(
    outcomes: Sequence[Outcome], description: ArmDescription, fps: int, job: JobOptions
) -> Iterator[Episode]:
    # Forward kinematics of a hundred short episodes together costs little more than that of one.
    for first in range(0, len(outcomes), _BATCH):
        batch = outcomes[first : first + _BATCH]
        measured = [follow_command(outcome.q, job.lag_s, fps)[:-1] for outcome in batch]
        poses = np.split(
            forward(description, np.concatenate(measured)), np.cumsum([len(q) for q in measured])[:-1]
        )
        for outcome, state, pose in zip(batch, measured, poses, strict=True):
            gripper = outcome.gripper
            yield Episode(
                state=state,
                action=outcome.q[1:],
                ee_pose=pose,
                ee_target=outcome.target[1:],
                task=outcome.task or job.task,
                session=outcome.session,
                gripper=None if gripper is None else np.stack([gripper[:-1], gripper[1:]], axis=1),
            )


def _work_off(
    recordings: list[Recording],
    store: PartStore,
    numbers: list[int],
    description: ArmDescription,
    options: RetargetOptions,
    job: JobOptions,
) -> None:
    """Make the missing parts, in this process or in others."""
    batches = {number: recordings[number * _BATCH : (number + 1) * _BATCH] for number in numbers}
    with tqdm(total=len(recordings), desc="retargeting", unit="recording", disable=not job.progress) as bar:
        bar.update(len(recordings) - sum(map(len, batches.values())))
        if job.workers == 0 or not numbers:
            retargeter = Retargeter(description, options)
            for number, batch in batches.items():
                save_outcomes(store.path(number), retargeter.retarget(batch, number * _BATCH))
                bar.update(len(batch))
            return
        with (
            _single_threaded(),
            worker_pool(min(job.workers, len(numbers)), _start_worker, (description, options)) as pool,
        ):
            futures = {
                pool.submit(_make_part, store.path(number), batch, number * _BATCH): len(batch)
                for number, batch in batches.items()
            }
            import_lerobot()  # takes seconds, in which the workers are busy anyway
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.update(futures[future])
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Let new processes use one thread each for linear algebra: there are as many processes as cores."""
    before = {name: os.environ.get(name) for name in _THREAD_SETTINGS}
    os.environ.update(dict.fromkeys(_THREAD_SETTINGS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_retargeter: Retargeter | None = None


def _start_worker(description: ArmDescription, options: RetargetOptions) -> None:
    global _retargeter
    _retargeter = Retargeter(description, options)


def _make_part(path: Path, batch: list[Recording], first_index: int) -> None:
    assert _retargeter is not None
    save_outcomes(path, _retargeter.retarget(batch, first_index))


def _fingerprint(recordings: Sequence[Recording]) -> str:
    """Hash of everything in the recordings."""
    digest = hashlib.sha256()
    for recording in recordings:
        digest.update(f"{recording.name}\n{recording.session}\n{recording.task}\n{len(recording)}\n".encode())
        for values in (recording.t, recording.pose, recording.gripper):
            digest.update(b"-" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _test_sessions(outcomes: Sequence[Outcome], share: float, seed: int) -> set[str]:
    """Sessions of the test split: drawn until they hold the fraction of the frames, at least one, never all."""
    if share == 0:
        return set()
    frames: Counter[str] = Counter()
    for outcome in outcomes:
        frames[outcome.session] += len(outcome.q)
    if len(frames) < 2:
        raise ValueError(
            f"a test split needs two sessions or more, found {len(frames)}; name the session columns or set "
            "the test share to 0"
        )
    names = sorted(frames)
    chosen: set[str] = set()
    for index in np.random.default_rng([seed, 1]).permutation(len(names))[: len(names) - 1]:
        if chosen and sum(frames[name] for name in chosen) >= share * frames.total():
            break
        chosen.add(names[index])
    return chosen
