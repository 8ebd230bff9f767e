"""Targets to follow: generated ones that end where they begin, and recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.stress.motion import everyday_motion
from lerobot_mimicik.data.teleoperation.singularities import KINDS
from lerobot_mimicik.evaluation.anatomy import make_trials
from lerobot_mimicik.evaluation.trajectories import load_trajectories
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.guidance.search import closest_configuration
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.chain import SerialArm

FPS = 20.0  # of generated motions
EPISODES = 10
"""How many episodes of a dataset are offered where the user names none."""

_ROUND_S = 6.0
_RADII = (0.16, 0.12, 0.08, 0.05)  # of the circle, as fractions of the reach
_ON_CIRCLE_M, _ALIKE_RAD = 1e-3, 0.01  # what a circle that the arm can follow is off, at most
_CALM_RAD = 0.05  # per frame: half of the bound on a step
_EVERYDAY_S = 20.0
# Axes of three joints are needed before anything can be singular.
_FEWEST_JOINTS = 3


@dataclass(frozen=True, eq=False)
class Motion:
    """Targets to follow.

    Attributes:
        name: How the page calls it.
        start: Joints (dof,) that the arm begins at.
        targets: `T_base_tool` at each frame, (T, 7).
        fps: Frames per second.
    """

    name: str
    start: Array
    targets: Array
    fps: float = FPS


def generated_motions(description: ArmDescription, seed: int = 0) -> list[Motion]:
    """A circle, the ways through the arm's singularities, out of reach and back, and everyday moves.

    Raises:
        ValueError: The description has no home.
    """
    arm = ArmArrays(description)
    motions = [_circle(description, arm)]
    if len(arm.lower) >= _FEWEST_JOINTS:
        for trial in make_trials(description, seed):
            name = f"{trial.name} singularity" if trial.name in KINDS else trial.name
            start, targets = trial.trajectory.q[0], trial.trajectory.target
            motions.append(Motion(f"{name[0].upper()}{name[1:]}", start, _there_and_back(targets)))
    q = everyday_motion(arm, round(_EVERYDAY_S * FPS), FPS, np.random.default_rng(seed))
    motions.append(Motion("Everyday moves", q[0], _there_and_back(arm.pose(q))))
    return motions


def recorded_motions(root: str | Path, arm: SerialArm, episodes: Sequence[int] = ()) -> list[Motion]:
    """Recordings of a LeRobot dataset; errors as `load_trajectories`.

    Args:
        root: The dataset's folder.
        arm: Whose motion it is, in float64.
        episodes: Their numbers; none: the first `EPISODES`.
    """
    found = load_trajectories(root, arm, episodes=episodes or None)
    chosen = found.trajectories if episodes else found.trajectories[:EPISODES]
    return [
        Motion(f"{found.name}, episode {each.index}", each.q[0], each.target, found.fps) for each in chosen
    ]


def _circle(description: ArmDescription, arm: ArmArrays) -> Motion:
    """The largest of some circles that the arm can follow from its home without turning the tool.

    Its poses are those of the joints that come closest, so that arms of fewer than six joints can follow as well.
    """
    model, home = arm_model(description), arm.pose(arm.home[None])[0]
    angle = np.linspace(0.0, 2 * np.pi, round(_ROUND_S * FPS), endpoint=False)
    flat = np.zeros_like(angle)
    for radius in _RADII:
        wanted = np.tile(home, (len(angle), 1))
        way = np.stack([flat, np.sin(angle), np.cos(angle) - 1], axis=1)
        wanted[:, :3] += radius * model.reach * way
        q = [arm.home]
        for target in wanted:
            q.append(closest_configuration(model, q[-1], target))
        step = np.abs(np.diff(q, axis=0)).max()
        targets = arm.pose(np.array(q[1:]))
        off = np.linalg.norm(targets[:, :3] - wanted[:, :3], axis=1).max()
        turned = 2 * np.arccos(np.abs((targets[:, 3:] * home[3:]).sum(axis=1)).clip(max=1.0)).max()
        if off < _ON_CIRCLE_M and turned < _ALIKE_RAD and step < _CALM_RAD:
            break
    return Motion("Circle", arm.home, targets)


def _there_and_back(targets: Array) -> Array:
    return np.concatenate([targets, targets[::-1]])
