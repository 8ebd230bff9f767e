"""Evaluating solvers on datasets in modes: one row of the report for each combination."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from lerobot_mimicik.evaluation.latency import Latency, measure_latency
from lerobot_mimicik.evaluation.metrics import Trace, measure, summarise
from lerobot_mimicik.evaluation.motion_metrics import bootstrap, collision_depth_mm, summarise_motion
from lerobot_mimicik.evaluation.rollouts import RolloutOptions, make_rollouts
from lerobot_mimicik.evaluation.trajectories import TrajectorySet
from lerobot_mimicik.evaluation.verdict import (
    Passage,
    Verdict,
    characteristic_length,
    find_passages,
    judge_all,
    smallest_singular_value,
)
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import SolverUnavailable
from lerobot_mimicik.solvers.base import Array, IKSolver


@dataclass(frozen=True, eq=False)
class StudiedSet:
    """A dataset as the evaluation sees it.

    Attributes:
        set: Its trajectories.
        singular_value: Smallest singular value along each trajectory, (T,) each.
        passages: Singular passages of each trajectory.
    """

    set: TrajectorySet
    singular_value: tuple[Array, ...]
    passages: tuple[tuple[Passage, ...], ...]

    def first(self, count: int) -> StudiedSet:
        """The first so many of its trajectories."""
        kept = replace(self.set, trajectories=self.set.trajectories[:count])
        return StudiedSet(kept, self.singular_value[:count], self.passages[:count])


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One row of the report and what it was computed from.

    Attributes:
        row: The row, by the keys of `report.json`.
        recording: The dataset.
        traces: Per-frame measurements, one for each trajectory.
        verdicts: One for each trajectory; empty where the mode gives none.
    """

    row: dict[str, Any]
    recording: StudiedSet
    traces: tuple[Trace, ...]
    verdicts: tuple[Verdict, ...]


def study(arm: SerialArm, trajectories: TrajectorySet) -> StudiedSet:
    """Find the singular passages of a dataset; `arm` in float64."""
    length = characteristic_length(arm)
    values = tuple(smallest_singular_value(arm, one.q, length) for one in trajectories.trajectories)
    passages = tuple(tuple(find_passages(value, trajectories.fps)) for value in values)
    return StudiedSet(trajectories, values, passages)


def evaluate(
    arm: SerialArm,
    solvers: Mapping[str, IKSolver],
    recordings: Sequence[StudiedSet],
    modes: Sequence[str],
    latency_queries: int = 200,
    seed: int = 0,
    progress: bool = False,
    unavailable: Callable[[str, str, str, str], None] | None = None,
) -> Iterator[Evaluation]:
    """Evaluate every solver on every dataset in every mode, one combination at a time.

    Args:
        arm: Measures all of them; float64, joints in the order of the recordings.
        solvers: By the name that the table shows.
        recordings: From `study`.
        modes: From `known_modes()`.
        latency_queries: Queries timed per solver, on the first trajectory of the first recording.
        seed: Set anew before each combination, for solvers and modes that draw noise.
        progress: Whether to show a bar for each combination.
        unavailable: Told solver, mode, dataset and reason of a combination that cannot be measured; None: that
            raises `SolverUnavailable`.

    Yields:
        Evaluations, ordered by dataset, mode and solver.
    """
    latencies: dict[str, Latency] = {}
    for name, solver in solvers.items():
        latencies[name] = measure_latency(solver, recordings[0].set.trajectories[0], latency_queries)
    for recording in recordings:
        for mode in modes:
            for name, solver in solvers.items():
                try:
                    evaluation = evaluate_one(
                        arm, name, solver, recording, mode, latencies[name], seed, progress
                    )
                except SolverUnavailable as error:
                    if unavailable is None:
                        raise
                    unavailable(name, mode, recording.set.name, str(error))
                else:
                    yield evaluation


def evaluate_one(
    arm: SerialArm,
    name: str,
    solver: IKSolver,
    recording: StudiedSet,
    mode: str,
    latency: Latency,
    seed: int = 0,
    progress: bool = False,
) -> Evaluation:
    """Evaluate one solver on one dataset in one mode; see `evaluate`."""
    torch.manual_seed(seed)
    label = f"{name}, {mode.replace('_', ' ')}, {recording.set.name}"
    options = RolloutOptions(seed=seed, progress=progress, label=label)
    rollouts = make_rollouts(mode, solver, recording.set.trajectories, options)
    return make_evaluation(arm, name, mode, recording, tuple(measure(arm, rollouts)), latency)


def make_evaluation(
    arm: SerialArm, name: str, mode: str, recording: StudiedSet, traces: tuple[Trace, ...], latency: Latency
) -> Evaluation:
    """The row of one solver on one dataset in one mode, and what it rests on."""
    row: dict[str, Any] = {"solver": name, "mode": mode, "dataset": recording.set.name}
    row |= summarise(traces)
    row |= summarise_motion(traces, recording.set.fps)
    row |= {
        "depth_mm": collision_depth_mm(arm.description, traces),
        "ci95": bootstrap(traces, recording.set.fps),
    }
    row |= {
        "latency_ms_median": latency.median_ms,
        "latency_ms_p95": latency.p95_ms,
        "latency_ms_p99": latency.p99_ms,
        "energy_mj": latency.energy_mj,
    }
    verdicts: list[Verdict] = []
    if mode == "open_loop":
        # Its commands have no consequences, so there is nothing to judge.
        row |= {"verdict": "-", "reason": ""}
    else:
        worst, verdicts = judge_all(traces, recording.passages, recording.set.fps)
        row |= {"verdict": worst.verdict, "reason": worst.reason}
    row["episodes"] = len(traces)
    row["failures"] = dict(Counter(verdict.failure for verdict in verdicts if verdict.failure))
    return Evaluation(row, recording, traces, tuple(verdicts))
