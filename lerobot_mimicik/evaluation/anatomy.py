"""What solvers do inside a singularity: through a wrist, an elbow and a shoulder one, and out of reach and back.

The arm is led through each by a joint motion, so that a smooth answer exists; a solver is given the poses alone,
in closed loop. The last target leaves the workspace along the line from the base, waits there and returns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.teleoperation.singularities import KINDS, SingularityGauge, find_singular
from lerobot_mimicik.evaluation.rollouts import Rollout, RolloutOptions, make_rollouts
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.solvers.base import IKSolver

OUT_OF_REACH = "out of reach"
FPS = 20.0
_HALF_WAY_S, _REST_S = 3.0, 1.0
_FAR_FROM_OTHERS = 0.25  # a passage is through one kind of singularity
_HALF_WIDTH_RAD = 0.5
_BEYOND = 1.1  # of the longest reach


@dataclass(frozen=True, eq=False)
class Trial:
    """One of the standard motions.

    Attributes:
        name: The kind of singularity, or `OUT_OF_REACH`.
        trajectory: Targets at 20 Hz; its joints are those of the leading motion, and out of reach the first ones.
        worst: Frame at which the arm is in the singularity, or the target furthest away.
    """

    name: str
    trajectory: Trajectory
    worst: int


def make_trials(description: ArmDescription, seed: int = 0) -> list[Trial]:
    """The standard motions of an arm, always the same for a seed; a kind that the arm lacks is left out.

    Raises:
        ValueError: If the description has no home posture.
    """
    arm = ArmArrays(description)
    rng = np.random.default_rng(seed)
    gauge = SingularityGauge.for_arm(arm, rng)
    middle, half = (arm.upper + arm.lower) / 2, (arm.upper - arm.lower) / 2
    start = np.concatenate([arm.home[None], middle + 0.7 * half * rng.uniform(-1, 1, (512, len(half)))])
    trials: list[Trial] = []
    for kind in KINDS:
        found = find_singular(gauge, kind, start)
        measures = gauge(found)
        others = np.min([measures[other] for other in KINDS if other != kind], axis=0)
        inside = np.flatnonzero(others > _FAR_FROM_OTHERS)
        if inside.size:
            # The nearest to the everyday posture.
            distance = np.abs(found[inside] - arm.home).max(axis=1)
            trials.append(_through(arm, gauge, kind, found[inside[distance.argmin()]], len(trials)))
    return [*trials, _out_of_reach(arm, len(trials))]


def run_trials(solver: IKSolver, trials: Sequence[Trial]) -> dict[str, Rollout]:
    """Drive a solver through the motions in closed loop; what it did, by the motions' names."""
    rollouts = make_rollouts("closed_loop", solver, [trial.trajectory for trial in trials], RolloutOptions())
    return {trial.name: rollout for trial, rollout in zip(trials, rollouts, strict=True)}


def save_commands(path: Path, rollouts: Mapping[str, Rollout]) -> None:
    """Keep the commands (T, dof) of every motion, as a numpy archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    commands: dict[str, Any] = {name: rollout.q_cmd for name, rollout in rollouts.items()}
    np.savez_compressed(path, **commands)


def load_commands(path: Path, trials: Sequence[Trial]) -> dict[str, Rollout]:
    """What `save_commands` kept, as rollouts again.

    Raises:
        ValueError: If the file is of other motions.
    """
    with np.load(path, allow_pickle=False) as kept:
        commands = {name: kept[name] for name in kept.files}
    rollouts = {}
    for trial in trials:
        q_cmd, trajectory = commands.get(trial.name), trial.trajectory
        if q_cmd is None or q_cmd.shape != trajectory.q.shape:
            raise ValueError(f"{path} is not of the motion {trial.name!r} of this arm: remove it.")
        q_curr = np.concatenate([trajectory.q[:1], q_cmd[:-1]])
        asked = int(np.isfinite(q_curr).all(axis=1).sum())
        rollouts[trial.name] = Rollout(trajectory, q_curr, q_cmd, asked)
    return rollouts


def _through(arm: ArmArrays, gauge: SingularityGauge, kind: str, singular: Array, index: int) -> Trial:
    """From one side of a singular configuration (dof,) to the other, or back where limits forbid it."""
    probe = 1e-3
    around = singular + probe * np.concatenate([np.eye(len(singular)), -np.eye(len(singular))])
    value = gauge(np.clip(around, arm.lower, arm.upper))[kind]
    # Next to zero an absolute value grows in every direction: along the joints that change it most.
    slope = np.maximum(*np.split(value, 2))
    way = _HALF_WIDTH_RAD * slope / slope.max()
    free = [bool(np.all((arm.lower <= end) & (end <= arm.upper))) for end in (singular + way, singular - way)]
    if not any(free):
        # Into the middle of each joint's range.
        way, free = np.where(singular > (arm.lower + arm.upper) / 2, -way, way), [True, False]
    before = singular + way if free[0] else singular - way
    after = 2 * singular - before if all(free) else before
    half, rest = round(_HALF_WAY_S * FPS), round(_REST_S * FPS)
    q = np.concatenate(
        [_eased(before, singular, half), np.tile(singular, (rest, 1)), _eased(singular, after, half)]
    )
    q = np.clip(q, arm.lower, arm.upper)
    target = arm.pose(np.concatenate([q[1:], q[-1:]]))
    return Trial(kind, Trajectory(index, q, target), half)


def _out_of_reach(arm: ArmArrays, index: int) -> Trial:
    """From the everyday posture straight away from the base, beyond any reach, and back."""
    rng = np.random.default_rng(0)
    samples = rng.uniform(arm.lower, arm.upper, (4096, len(arm.lower)))
    reach = np.linalg.norm(arm.pose(samples)[:, :3], axis=1).max()
    home = arm.pose(arm.home[None])[0]
    outward = home[:3] / np.linalg.norm(home[:3])
    way = (_BEYOND * reach - np.linalg.norm(home[:3])) * outward
    half, rest = round(_HALF_WAY_S * FPS), round(2 * _REST_S * FPS)
    share = np.concatenate(
        [_eased(np.zeros(1), np.ones(1), half), np.ones((rest, 1)), _eased(np.ones(1), np.zeros(1), half)]
    )
    share = np.concatenate([share, np.zeros((rest, 1))])
    target = np.concatenate([home[:3] + share * way, np.tile(home[3:], (len(share), 1))], axis=1)
    return Trial(OUT_OF_REACH, Trajectory(index, np.tile(arm.home, (len(share), 1)), target), half)


def _eased(a: Array, b: Array, frames: int) -> Array:
    """Minimum-jerk motion (frames, n) from `a` to `b`."""
    phase = np.linspace(0.0, 1.0, frames)[:, None]
    return a + (b - a) * phase**3 * (10 - 15 * phase + 6 * phase**2)
