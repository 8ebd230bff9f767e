"""Driving a solver along recorded motion: the modes of evaluation and what they leave behind.

A mode is a function `(solver, trajectories, options) -> list of Rollout` registered by name with
`register_mode`; everything after it (metrics, verdicts, report) treats all modes alike. Modes that need an
arm come from elsewhere: modules of the entry-point group `mimicik.modes` register theirs when imported.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.names import did_you_mean
from lerobot_mimicik.solvers.base import Array, IKSolver, OfflineSolver


@dataclass(frozen=True, eq=False)
class Rollout:
    """What a solver did along one trajectory of T frames.

    Attributes:
        trajectory: The recording that it was driven along.
        q_curr: Joints that the solver was told, (T, dof), rad.
        q_cmd: Its commands, (T, dof), rad.
        asked: Number of frames it was asked about; fewer than T where it was stopped after a non-finite
            command (the last one asked), and then rows from `asked` on are NaN.
    """

    trajectory: Trajectory
    q_curr: Array
    q_cmd: Array
    asked: int


@dataclass(frozen=True)
class RolloutOptions:
    """What a mode may need besides solver and trajectories.

    Attributes:
        seed: For modes that draw noise.
        progress: Whether to show a progress bar.
        label: Its text.
    """

    seed: int = 0
    progress: bool = False
    label: str = ""


Mode = Callable[[IKSolver, Sequence[Trajectory], RolloutOptions], list[Rollout]]
_MODES: dict[str, Mode] = {}


def register_mode(name: str) -> Callable[[Mode], Mode]:
    """Make `make_rollouts(name, ...)` call the decorated function."""

    def register(mode: Mode) -> Mode:
        if _MODES.get(name, mode) is not mode:
            raise ValueError(f"A mode called {name!r} is already registered: {_MODES[name]!r}.")
        _MODES[name] = mode
        return mode

    return register


def known_modes() -> tuple[str, ...]:
    """Names that `make_rollouts` takes."""
    for entry in entry_points(group="mimicik.modes"):
        entry.load()
    return tuple(_MODES)


def make_rollouts(
    mode: str, solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions | None = None
) -> list[Rollout]:
    """Drive `solver` along `trajectories` in the named mode; rollouts come in the same order.

    Raises:
        ValueError: If no mode has that name.
    """
    if mode not in _MODES and mode not in known_modes():
        raise ValueError(f"Unknown mode {mode!r}; known are {', '.join(_MODES)}.{did_you_mean(mode, _MODES)}")
    return _MODES[mode](solver, trajectories, options or RolloutOptions())


@register_mode("open_loop")
def open_loop(solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions) -> list[Rollout]:
    """Recorded joints in, at every frame, whatever the solver answered before (the paper's offline table)."""
    rollouts = []
    with frame_bar(sum(map(len, trajectories)), options.label, options.progress) as bar:
        for trajectory in trajectories:
            q_cmd = solver.solve_recorded(trajectory.q, trajectory.target)
            rollouts.append(Rollout(trajectory, trajectory.q, q_cmd, len(trajectory)))
            bar.update(len(trajectory))
    return rollouts


@register_mode("closed_loop")
def closed_loop(
    solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions
) -> list[Rollout]:
    """The first measured joints in; from then on every command is the next measurement.

    A trajectory whose command is not finite is stopped there; the others go on.
    """
    if isinstance(solver, OfflineSolver):
        return _offline(solver, trajectories, options)
    groups = [list(trajectories)] if solver.batched else [[trajectory] for trajectory in trajectories]
    rollouts: list[Rollout] = []
    with frame_bar(sum(map(len, trajectories)), options.label, options.progress) as bar:
        for group in groups:
            rollouts += _closed_loop_lockstep(solver, group, bar)
    return rollouts


def _offline(
    solver: OfflineSolver, trajectories: Sequence[Trajectory], options: RolloutOptions
) -> list[Rollout]:
    """Whole recordings at once; each command is the next measurement here too."""
    rollouts = []
    with frame_bar(sum(map(len, trajectories)), options.label, options.progress) as bar:
        for trajectory in trajectories:
            q_cmd = solver.solve_recorded(trajectory.q, trajectory.target)
            q_curr = np.concatenate([trajectory.q[:1], q_cmd[:-1]])
            rollouts.append(Rollout(trajectory, q_curr, q_cmd, len(trajectory)))
            bar.update(len(trajectory))
    return rollouts


def frame_bar(frames: int, label: str, shown: bool) -> tqdm:
    """A progress bar over frames, on stderr."""
    # A file keeps every state of the bar.
    interval = 0.2 if sys.stderr.isatty() else 10.0
    return tqdm(total=frames, unit="frame", desc=label, disable=not shown, mininterval=interval)


def _closed_loop_lockstep(solver: IKSolver, trajectories: list[Trajectory], bar: tqdm) -> list[Rollout]:
    """All trajectories at once, one batch row each; rows leave as their trajectories end."""
    if not trajectories:
        return []
    lengths = np.array([len(trajectory) for trajectory in trajectories])
    dof = trajectories[0].q.shape[1]
    target = np.zeros((len(trajectories), lengths.max(), 7))
    for row, trajectory in enumerate(trajectories):
        target[row, : len(trajectory)] = trajectory.target
    q_curr = np.full((len(trajectories), lengths.max(), dof), np.nan)
    q_cmd = np.full_like(q_curr, np.nan)
    asked = np.zeros(len(trajectories), dtype=int)

    q = np.stack([trajectory.q[0] for trajectory in trajectories])
    rows = np.arange(len(trajectories))
    solver.reset(q if solver.batched else q[0])
    for t in range(lengths.max()):
        going = (lengths[rows] > t) & np.isfinite(q[rows]).all(axis=1)
        if not going.all():
            rows = rows[going]
            if not rows.size:
                break
            solver.select(np.flatnonzero(going))
        q_curr[rows, t] = q[rows]
        if solver.look_ahead and not solver.batched:
            row = rows[0]
            solver.foresee(target[row, t + 1 : min(t + 1 + solver.look_ahead, lengths[row])])
        q[rows] = _solve(solver, q[rows], target[rows, t])
        q_cmd[rows, t] = q[rows]
        asked[rows] += 1
        bar.update(len(rows))
    return [
        Rollout(trajectory, q_curr[row, : len(trajectory)], q_cmd[row, : len(trajectory)], int(asked[row]))
        for row, trajectory in enumerate(trajectories)
    ]


def _solve(solver: IKSolver, q: Array, target: Array) -> NDArray[np.float64]:
    """(B, dof) and (B, 7) -> (B, dof); B is one where the solver takes single configurations."""
    if solver.batched:
        return solver.solve(q, target)
    return solver.solve(q[0], target[0])[None]
