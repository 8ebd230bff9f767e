"""Two solvers that follow a trembling hand through a singularity: the guided one, and beside it what LeRobot has.

Beside it stands LeRobot's own inverse kinematics where placo is installed, else an undamped solver. Both are driven in
closed loop by the same targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.data.home import with_home
from lerobot_mimicik.evaluation.anatomy import FPS, OUT_OF_REACH, make_trials
from lerobot_mimicik.evaluation.metrics import ESTOP_RAD
from lerobot_mimicik.evaluation.rollouts import make_rollouts
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.tremor import displaced, tremor
from lerobot_mimicik.kinematics.urdf import read_urdf
from lerobot_mimicik.solvers.base import IKSolver, available_solvers, make_solver

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

TREMOR_MM = 1.0
"""Root mean square of the hand's trembling; half a degree goes with it."""

_OURS = "guided"
# Who may stand beside it, the first that is installed: solver, its name in the picture, what it is in a sentence.
_BESIDE = (
    ("placo_lerobot", "LeRobot's own", "LeRobot's own inverse kinematics (RobotKinematics, by placo)"),
    ("undamped", "undamped", "an undamped solver (placo, which LeRobot's own needs, is not installed)"),
)


@dataclass(frozen=True, eq=False)
class Follower:
    """What one solver did.

    Attributes:
        name: How the picture calls it.
        about: What it is, for a sentence.
        q: The first joints and the commands after them, (T + 1, dof) [rad, m].
        tool: Position of the tool at these joints, (T + 1, 3) [m].
        steps: Largest joint step of each frame, (T,) [rad, m].
        error_mm: Distance of the commanded tool from the target, (T,).
    """

    name: str
    about: str
    q: Array
    tool: Array
    steps: Array
    error_mm: Array


@dataclass(frozen=True, eq=False)
class SideBySide:
    """A motion through a singularity, and who followed it.

    Attributes:
        arm: Whose it is.
        kind: Of the singularity: wrist, elbow or shoulder.
        target: Poses that the hand asks for, (T, 7), at `anatomy.FPS` frames a second.
        worst: Frame at which the hand is in the singularity.
        followers: Who follows; the guided solver last.
    """

    arm: ArmDescription
    kind: str
    target: Array
    worst: int
    followers: tuple[Follower, ...]

    def sentence(self) -> str:
        """What happened, in numbers."""
        beside, ours = self.followers
        told = [
            f"{one.about} turns a joint by up to {_number(one.steps)} rad between two frames, "
            f"its error is {one.error_mm.mean():.2f} mm on average and {one.error_mm.max():.1f} mm at most"
            for one in (beside, ours)
        ]
        name = read_urdf(self.arm.urdf).name
        return (
            f"A hand that trembles by {TREMOR_MM:g} mm leads the arm {name} through its {self.kind} singularity with "
            f"{FPS:g} targets a second. {told[0][0].upper()}{told[0][1:]}; {told[1]}. "
            f"A real arm stops at steps above {ESTOP_RAD:g} rad."
        )


def follow(
    description: ArmDescription, seed: int = 0, policy: LearnedIKPolicy | None = None
) -> SideBySide | None:
    """Drive both solvers through the arm's first kind of singularity; None for an arm without any.

    Args:
        description: The arm.
        seed: Of the tremor.
        policy: A checkpoint that the guided solver has; None: it runs without.
    """
    description = with_home(description)
    trial = make_trials(description, seed)[0]
    if trial.name == OUT_OF_REACH:
        return None
    shaking = tremor(len(trial.trajectory), FPS, TREMOR_MM, np.random.default_rng(seed))
    q, target = trial.trajectory.q, displaced(trial.trajectory.target, shaking)
    trajectory, arm = Trajectory(0, q, target, arm=description), SerialArm(description)
    missing = available_solvers(name for name, *_ in _BESIDE)
    solver, name, about = next(row for row in _BESIDE if missing[row[0]] is None)
    if policy is None:
        ours = _followed(make_solver(_OURS, arm), _OURS, "the guided solver", trajectory)
    else:
        own = make_solver(
            "foresight" if policy.name == "mimicik_foresight" else "mimicik_guided", arm, policy=policy
        )
        ours = _followed(own, "this checkpoint", "the guided solver with this checkpoint", trajectory)
    followers = (
        _followed(make_solver(solver, arm), name, about, trajectory),
        ours,
    )
    return SideBySide(description, trial.name, target, trial.worst, followers)


def _followed(solver: IKSolver, name: str, about: str, trajectory: Trajectory) -> Follower:
    rollout = make_rollouts("closed_loop", solver, [trajectory])[0]
    q = np.concatenate([rollout.q_curr[:1], rollout.q_cmd])
    assert trajectory.arm is not None
    tool = array_chain(trajectory.arm).pose(q)[:, :3]
    steps = np.abs(np.diff(q, axis=0)).max(axis=1)
    error = 1e3 * np.linalg.norm(tool[1:] - trajectory.target[:, :3], axis=1)
    return Follower(name, about, q, tool, steps, error)


def _number(steps: Sequence[float] | Array) -> str:
    largest = float(np.max(steps))
    return f"{largest:.2f}" if largest < 10 else f"{largest:.0f}"
