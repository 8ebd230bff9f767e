"""Synthetic teleoperation as LeRobot datasets: who records what, in which split, on how many processes."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from lerobot_mimicik import outputs
from lerobot_mimicik.data.teleoperation.scene import Scene
from lerobot_mimicik.data.teleoperation.session import (
    SessionPlan,
    SyntheticConfig,
    record_near_singular,
    record_sessions,
)
from lerobot_mimicik.data.workers import worker_pool
from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.kinematics.arms import ArmDescription

__all__ = ["SyntheticConfig", "SyntheticSummary", "make_synthetic", "plan_sessions"]

Result = TypeVar("Result")

# Sessions simulated together. Fixed, so that the result does not depend on the number of workers.
_SESSIONS_PER_JOB = 4
_SCENE_STREAM, _SESSION_STREAM, _SPLIT_STREAM, _OOD_STREAM = range(4)


@dataclass(frozen=True)
class SyntheticSummary:
    """What `make_synthetic` wrote.

    Attributes:
        roots: Folder of each split ("train", "test", "ood").
        episodes, frames, sessions: Counts by split.
        recovery: Recovery episodes over all splits.
        kinds: The kinds of singularity that the arm has and the data visit.
    """

    roots: dict[str, Path]
    episodes: dict[str, int]
    frames: dict[str, int]
    sessions: dict[str, int]
    recovery: int
    kinds: tuple[str, ...]

    def __str__(self) -> str:
        lines = [
            f"{split}: {self.episodes[split]} episodes, {self.frames[split]} frames, "
            f"{self.sessions[split]} sessions -> {root}"
            for split, root in self.roots.items()
        ]
        kinds = ", ".join(self.kinds) or "none"
        return "\n".join([*lines, f"recovery episodes: {self.recovery}; singularities: {kinds}"])


def make_synthetic(
    output: Path,
    episodes: int,
    description: ArmDescription,
    *,
    seed: int = 0,
    workers: int = 2,
    test_share: float = 0.15,
    ood: bool = True,
    config: SyntheticConfig | None = None,
    progress: bool = True,
    overwrite: bool = False,
    space: str = "joints",
) -> SyntheticSummary:
    """Generates teleoperation of an arm and writes it as `output`/train, `output`/test and `output`/ood.

    The same seed gives the same datasets, whatever the number of workers.

    Args:
        output: Folder for the datasets.
        episodes: Number of episodes of train and test together.
        description: The arm; its `home` is the posture about which operators work.
        seed: Of everything random, not negative.
        workers: Number of processes.
        test_share: Share of the sessions that go to the test split; 0 writes none.
        ood: Whether to write the near-singular trajectories.
        config: How the motion is recorded.
        progress: Whether to show a bar.
        overwrite: Replace datasets that are already there.
        space: Of state and action, one of `writer.SPACES`.

    Raises:
        ValueError: Counts or shares out of range, or an arm without a home configuration.
        FileExistsError: A folder is already there, or is none that may be replaced.
    """
    config = config or SyntheticConfig()
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    splits = ["train", *(["test"] if test_share > 0 else []), *(["ood"] if ood else [])]
    roots = {split: Path(output) / split for split in splits}
    for root in roots.values():
        outputs.check_new(root, "dataset", overwrite)
    scene = Scene.of(description, _rng(seed, _SCENE_STREAM))
    plans = plan_sessions(episodes, tuple(scene.singular), seed, test_share, config)
    near_singular = [
        SessionPlan(f"near-singular-{i}", (seed, _OOD_STREAM, i), 0)
        for i in range(config.ood_episodes if ood else 0)
    ]
    if near_singular and not scene.singular:
        raise ValueError(
            "no singular configuration was found for this arm: ask for the datasets without `ood`"
        )

    jobs: list[tuple[Callable, Sequence]] = [(_near_singular, [plan]) for plan in near_singular]
    names = {plan.name for split in plans.values() for plan in split}
    everyday = [plan for split in plans.values() for plan in split]
    jobs += [
        (_sessions, everyday[i : i + _SESSIONS_PER_JOB]) for i in range(0, len(everyday), _SESSIONS_PER_JOB)
    ]
    recorded: dict[str, list[Episode]] = {}
    total = len(names) + len(near_singular)
    with tqdm(total=total, desc="sessions", unit="session", disable=not progress) as bar:
        for result in _run(scene, config, jobs, workers):
            recorded.update(result)
            bar.update(len(result))

    members = {split: [plan.name for plan in chosen] for split, chosen in plans.items()}
    members["ood"] = [plan.name for plan in near_singular]
    written = {}
    for split, root in roots.items():
        found = [episode for name in members[split] for episode in recorded[name]]
        written[split] = write_dataset(
            root, f"local/{split}", found, description, fps=config.fps, overwrite=overwrite, space=space
        )
    return SyntheticSummary(
        roots=roots,
        episodes={split: counts["episodes"] for split, counts in written.items()},
        frames={split: counts["frames"] for split, counts in written.items()},
        sessions={split: len(members[split]) for split in roots},
        recovery=sum(len(plan.recovery) for plan in everyday),
        kinds=tuple(scene.singular),
    )


def plan_sessions(
    episodes: int, kinds: Sequence[str], seed: int, test_share: float, config: SyntheticConfig
) -> dict[str, list[SessionPlan]]:
    """Deals `episodes` to sessions and the sessions to "train" and, with a `test_share`, "test".

    Both splits get at least one session, and recovery episodes in proportion, each kind in turn.

    Raises:
        ValueError: Too few episodes for the splits, or a share outside 0..1.
    """
    if not 0 <= test_share < 1:
        raise ValueError(f"test_share must be at least 0 and below 1, got {test_share}")
    least = 2 if test_share > 0 else 1
    if episodes < least:
        raise ValueError(f"{episodes} episodes are too few: at least {least}, one session for each split")
    count = max(math.ceil(episodes / config.episodes_per_session), least)
    sizes = [episodes // count + (i < episodes % count) for i in range(count)]
    test_count = min(max(1, round(count * test_share)), count - 1) if test_share > 0 else 0
    chosen = set(_rng(seed, _SPLIT_STREAM).permutation(count)[:test_count].tolist())
    split_of = ["test" if i in chosen else "train" for i in range(count)]
    plans: dict[str, list[SessionPlan]] = {split: [] for split in ("train", "test")[: 1 + (test_share > 0)]}
    seen = dict.fromkeys(plans, 0)
    for i, size in enumerate(sizes):
        split = split_of[i]
        share = config.recovery_share if kinds else 0.0
        first, last = (math.floor(n * share + 0.5) for n in (seen[split], seen[split] + size))
        seen[split] += size
        recovery = tuple(kinds[n % len(kinds)] for n in range(first, last))
        plans[split].append(
            SessionPlan(f"session-{i:03d}", (seed, _SESSION_STREAM, i), size - len(recovery), recovery)
        )
    return plans


def _rng(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence((seed, stream)))


def _run(
    scene: Scene, config: SyntheticConfig, jobs: Sequence[tuple[Callable, Sequence]], workers: int
) -> Iterator[dict[str, list[Episode]]]:
    """Results of the jobs as they are ready, in order."""
    if workers == 1 or len(jobs) == 1:
        for job, plans in jobs:
            yield job(scene, plans, config)
        return
    with worker_pool(min(workers, len(jobs)), _start_worker, (scene, config)) as pool:
        yield from (future.result() for future in [pool.submit(_work, job, plans) for job, plans in jobs])


_worker: tuple[Scene, SyntheticConfig]


def _start_worker(scene: Scene, config: SyntheticConfig) -> None:
    global _worker
    _worker = (scene, config)


def _work(job: Callable, plans: Sequence[SessionPlan]) -> dict[str, list[Episode]]:
    scene, config = _worker
    return job(scene, plans, config)


def _sessions(
    scene: Scene, plans: Sequence[SessionPlan], config: SyntheticConfig
) -> dict[str, list[Episode]]:
    return {
        plan.name: found for plan, found in zip(plans, record_sessions(scene, plans, config), strict=True)
    }


def _near_singular(
    scene: Scene, plans: Sequence[SessionPlan], config: SyntheticConfig
) -> dict[str, list[Episode]]:
    return {plan.name: [record_near_singular(scene, plan, config)] for plan in plans}
