"""How long one query takes, asked one at a time as a control loop does."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.evaluation.energy import EnergyMeter
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.solvers.base import IKSolver, OfflineSolver

WARM_UP_QUERIES = 20


@dataclass(frozen=True)
class Latency:
    """Duration of one query at batch 1, in ms, over `queries` queries after a warm-up.

    `energy_mj` is the machine's energy for one, in mJ; None where it does not tell.
    """

    median_ms: float
    p99_ms: float
    queries: int
    energy_mj: float | None = None
    p95_ms: float | None = None


def measure_latency(solver: IKSolver, trajectory: Trajectory, queries: int = 200) -> Latency:
    """Time `solver` along the recorded frames of one trajectory, from the start again where it ends.

    Args:
        solver: Is reset, and asked about one configuration at a time; one that takes whole recordings only is timed
            once, and its time divided by the frames.
        trajectory: Where the questions come from.
        queries: How many are timed; the first `WARM_UP_QUERIES` before them are not.

    Raises:
        ValueError: If `queries` is below one.
    """
    if queries < 1:
        raise ValueError(f"Latency needs at least one query, got {queries}.")
    if isinstance(solver, OfflineSolver):
        begin = time.perf_counter()
        solver.solve_recorded(trajectory.q, trajectory.target)
        each_ms = 1e3 * (time.perf_counter() - begin) / len(trajectory)
        return Latency(each_ms, each_ms, len(trajectory), p95_ms=each_ms)
    solver.reset_one(trajectory.q[0])
    seconds = np.empty(WARM_UP_QUERIES + queries)
    meter = EnergyMeter()
    for i in range(len(seconds)):
        if i == WARM_UP_QUERIES:
            meter = EnergyMeter()
        t = i % len(trajectory)
        q_curr, target = trajectory.q[t], trajectory.target[t]
        if solver.look_ahead:
            solver.foresee(trajectory.target[t + 1 : t + 1 + solver.look_ahead])
        begin = time.perf_counter()
        solver.solve_one(q_curr, target)
        seconds[i] = time.perf_counter() - begin
    joules = meter.joules()
    milliseconds = 1e3 * seconds[WARM_UP_QUERIES:]
    return Latency(
        float(np.median(milliseconds)),
        float(np.percentile(milliseconds, 99)),
        queries,
        None if joules is None else 1e3 * joules / queries,
        float(np.percentile(milliseconds, 95)),
    )
