"""Retargeting: recordings of a hand's motion become joint trajectories of an arm.

For each recording: clean it, then try placements (see `placement`) until one can be followed:

    propose several -> inverse kinematics of a few waypoints -> the first that is reachable and collision-free
      -> whole trajectory -> slow it where joints are too fast -> whole trajectory again -> check every frame

A recording whose placements all fail is tried smaller, a few times, and then dropped with the reason. All
recordings of a batch go through each stage together. What comes out depends on the recording's own index and
the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from lerobot_mimicik.data.retargeting.cleaning import (
    CleaningOptions,
    CleanTrajectory,
    UnusableRecording,
    clean_recording,
    continuous_signs,
)
from lerobot_mimicik.data.retargeting.placement import (
    Motion,
    Placement,
    PlacementOptions,
    find_workspace,
    propose,
)
from lerobot_mimicik.data.retargeting.recordings import Recording
from lerobot_mimicik.data.slowing import resample, stretched_clock
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.collision import ArmCollision
from lerobot_mimicik.kinematics.trajectory_ik import (
    TrajectoryOptions,
    TrajectorySolution,
    solve_trajectories,
)

KEPT, CHANGED, DROPPED = "kept", "changed", "dropped"
_WAYPOINT_SPACING = 5  # frames between the poses that a placement is tried on: 0.25 s at 20 Hz
_SHRINK = 0.85  # size of the motion from one round of placements to the next
# A solution with a joint further from home [rad] belongs to another posture, such as a wrist turned over.
_POSTURE = 2.6
_SLOWING_ROUNDS = 3  # solving anew moves the fastest frame, so that one round need not be enough


@dataclass(frozen=True)
class RetargetOptions:
    """How recordings are made to fit an arm.

    Attributes:
        cleaning: Repair and resampling of the recording.
        placement: Room and freedom of placements.
        max_step: A joint never moves further in one frame [rad]; the paper warns from 0.1 on.
        step_margin: The motion is slowed to this fraction of `max_step`.
        max_position_error, max_rotation_error: A frame further off its target spoils the trajectory [m],
            [rad].
        clearance: Distance kept from the arm itself and the floor [m].
        floor: Height of the floor in the base frame [m], None for none.
        candidates: Placements proposed at a time.
        attempts: Rounds of proposals; from the third on each is 15 % smaller.
        smoothness: See `TrajectoryOptions`.
        seed: Source of all randomness.
    """

    cleaning: CleaningOptions = field(default_factory=CleaningOptions)
    placement: PlacementOptions = field(default_factory=PlacementOptions)
    max_step: float = 0.1
    step_margin: float = 0.9
    max_position_error: float = 0.4e-3
    max_rotation_error: float = 2.5e-3
    clearance: float = 0.005
    floor: float | None = 0.0
    candidates: int = 4
    attempts: int = 8
    smoothness: float = 1e3
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("max_step", "max_position_error", "max_rotation_error", "smoothness"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.step_margin <= 1:
            raise ValueError(f"step_margin must be in (0, 1], got {self.step_margin}")
        if self.candidates < 1 or self.attempts < 1:
            raise ValueError(
                f"candidates and attempts must be at least 1, got {self.candidates}, {self.attempts}"
            )


@dataclass
class Outcome:
    """What became of one recording.

    Attributes:
        name, session, task: Of the recording.
        status: KEPT (its motion at its own size and speed), CHANGED or DROPPED.
        reason: Why it was dropped, else empty.
        changes: What was changed, cause -> amount (a factor, or a number of rows).
        q: Joint command of every frame [rad], shape (T, dof); empty if dropped.
        target: Pose asked for at every frame, T_base_tool (T, 7).
        gripper: Shape (T,) or None.
    """

    name: str
    session: str
    task: str
    status: str
    reason: str = ""
    changes: dict[str, float] = field(default_factory=dict)
    q: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    target: np.ndarray = field(default_factory=lambda: np.empty((0, 7)))
    gripper: np.ndarray | None = None


@dataclass
class _Job:
    """A recording on its way through the stages."""

    recording: Recording
    clean: CleanTrajectory
    motion: Motion
    rng: np.random.Generator
    reason: str = "no placement tried"
    placement: Placement | None = None
    guess: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    target: np.ndarray = field(default_factory=lambda: np.empty((0, 7)))
    gripper: np.ndarray | None = None
    slowed: float = 1.0
    solution: TrajectorySolution | None = None


class Retargeter:
    """Retargets batches of recordings to one arm."""

    def __init__(self, description: ArmDescription, options: RetargetOptions | None = None) -> None:
        """Find the arm's workspace and lay its collision spheres.

        Raises:
            ValueError: The workspace asked for cannot be reached.
        """
        self.description = description
        self.options = options or RetargetOptions()
        self.workspace = find_workspace(description, self.options.placement, self.options.floor)
        self.collision = ArmCollision(description, self.workspace.home, self.options.floor)

    def retarget(self, recordings: Sequence[Recording], first_index: int = 0) -> list[Outcome]:
        """Outcomes of a batch of recordings, in order.

        Args:
            recordings: The batch.
            first_index: Index of its first recording in the whole source: it seeds the placements.
        """
        outcomes: dict[int, Outcome] = {}
        jobs: dict[int, _Job] = {}
        for position, recording in enumerate(recordings):
            rng = np.random.default_rng([self.options.seed, first_index + position])
            try:
                clean = clean_recording(recording, self.options.cleaning)
                jobs[position] = _Job(recording, clean, Motion.of(clean.pose), rng)
            except UnusableRecording as error:
                outcomes[position] = Outcome(
                    recording.name, recording.session, recording.task, DROPPED, str(error.reason)
                )
        for attempt in range(self.options.attempts):
            if not jobs:
                break
            shrink = _SHRINK ** max(0, attempt - 1)
            for position in self._attempt(jobs, shrink):
                outcomes[position] = self._outcome(jobs.pop(position))
        for position, job in jobs.items():
            recording = job.recording
            outcomes[position] = Outcome(
                recording.name, recording.session, recording.task, DROPPED, job.reason
            )
        return [outcomes[position] for position in range(len(recordings))]

    def _attempt(self, jobs: dict[int, _Job], shrink: float) -> list[int]:
        """One round of placements; which jobs have a solution now."""
        placed = self._place(jobs, shrink)
        if not placed:
            return []
        active = [jobs[position] for position in placed]
        solutions = solve_trajectories(
            self.description,
            [job.target for job in active],
            np.stack([job.guess[0] for job in active]),
            self._ik(),
            warm_start=[job.guess for job in active],
        )
        for job, solution in zip(active, solutions, strict=True):
            job.solution = solution
        slow = self._slow(jobs, [position for position in placed if self._nearly_follows(jobs[position])])
        return [position for position in slow if self._clear(jobs[position])]

    def _place(self, jobs: dict[int, _Job], shrink: float) -> list[int]:
        """Give each job the first of its proposals whose waypoints can be reached; which jobs got one."""
        count, options = self.options.candidates, self.options
        proposals = {
            position: [
                propose(job.motion, self.workspace, options.placement, shrink, job.rng) for _ in range(count)
            ]
            for position, job in jobs.items()
        }
        coarse: list[np.ndarray] = []
        for position, job in jobs.items():
            rows = _waypoints(len(job.clean.pose))
            for placement in proposals[position]:
                coarse.append(placement.apply(job.motion, rows))
        coarse_options = TrajectoryOptions(approach_iterations=30, frame_iterations=4, iterations=0)
        solutions = solve_trajectories(
            self.description, coarse, np.tile(self.workspace.home, (len(coarse), 1)), coarse_options
        )
        lengths = np.cumsum([0] + [len(solution.q) for solution in solutions])
        clearance = self.collision.clearance(np.concatenate([solution.q for solution in solutions]))
        placed = []
        for number, (position, job) in enumerate(jobs.items()):
            job.placement = None
            for candidate in range(count):
                index = number * count + candidate
                solution = solutions[index]
                if solution.position_error.max() > 2e-3 or solution.rotation_error.max() > 2e-2:
                    job.reason = "out of reach"
                elif np.abs(solution.q - self.workspace.home).max() > _POSTURE:
                    job.reason = "another posture"
                elif clearance[lengths[index] : lengths[index + 1]].min() < options.clearance:
                    job.reason = "collision"
                else:
                    job.placement = proposals[position][candidate]
                    length = len(job.clean.pose)
                    job.guess = CubicSpline(_waypoints(length), solution.q)(np.arange(length))
                    job.target = job.placement.apply(job.motion)
                    job.target[:, 3:] = continuous_signs(job.target[:, 3:])
                    job.gripper, job.slowed = job.clean.gripper, 1.0
                    placed.append(position)
                    break
        return placed

    def _slow(self, jobs: dict[int, _Job], positions: list[int]) -> list[int]:
        """Slow what is too fast or strays, and solve it again; which jobs keep the speed limit and follow.

        An arm strays where it passes a singularity too quickly: there twice the time lets it turn its wrist.
        """
        limit = self.options.max_step * self.options.step_margin
        done: list[int] = []
        for _ in range(_SLOWING_ROUNDS):
            wanting = [p for p in positions if _largest_step(jobs[p]) > limit or not self._follows(jobs[p])]
            done += [p for p in positions if p not in wanting]
            if not wanting:
                break
            warm = []
            for job in (jobs[position] for position in wanting):
                assert job.solution is not None
                clock = stretched_clock(job.solution.q, 0.97 * limit, 1.0 + self._strays(job.solution))
                job.slowed *= (len(clock) - 1) / (len(job.target) - 1)
                job.target, joints = resample(job.target, job.solution.q, clock)
                warm.append(joints)
                if job.gripper is not None:
                    job.gripper = np.interp(clock, np.arange(len(job.gripper)), job.gripper)
            solutions = solve_trajectories(
                self.description,
                [jobs[p].target for p in wanting],
                np.stack([q[0] for q in warm]),
                self._ik(),
                warm_start=warm,
            )
            for position, solution in zip(wanting, solutions, strict=True):
                jobs[position].solution = solution
            positions = [p for p in wanting if self._nearly_follows(jobs[p])]
        for position in positions:
            if position in done or not self._follows(jobs[position]):
                continue
            if _largest_step(jobs[position]) <= self.options.max_step:
                done.append(position)
            else:
                jobs[position].reason = "too fast, even slowed down"
        return sorted(done)

    def _strays(self, solution: TrajectorySolution) -> np.ndarray:
        """Which frames are not on their target, shape (T,)."""
        return (solution.position_error > self.options.max_position_error) | (
            solution.rotation_error > self.options.max_rotation_error
        )

    def _nearly_follows(self, job: _Job) -> bool:
        """Whether the trajectory is near enough its target that more time may bring it there."""
        assert job.solution is not None
        if job.solution.position_error.max() < 0.02 and job.solution.rotation_error.max() < 0.2:
            return True
        job.reason = "not followed within tolerance"
        return False

    def _follows(self, job: _Job) -> bool:
        """Whether every frame is on its target."""
        assert job.solution is not None
        if not self._strays(job.solution).any():
            return True
        job.reason = "not followed within tolerance"
        return False

    def _clear(self, job: _Job) -> bool:
        assert job.solution is not None
        if self.collision.clearance(job.solution.q).min() >= self.options.clearance:
            return True
        job.reason = "collision"
        return False

    def _ik(self) -> TrajectoryOptions:
        return TrajectoryOptions(smoothness=self.options.smoothness)

    def _outcome(self, job: _Job) -> Outcome:
        assert job.placement is not None
        assert job.solution is not None
        changes: dict[str, float] = dict(job.clean.repairs)
        for cause, factor in (
            ("translation scaled", job.placement.scale),
            ("rotation scaled", job.placement.rotation_scale),
            ("slowed down", job.slowed),
        ):
            if abs(factor - 1.0) > 1e-3:
                changes[cause] = round(float(factor), 4)
        return Outcome(
            name=job.recording.name,
            session=job.recording.session,
            task=job.recording.task,
            status=CHANGED if changes else KEPT,
            changes=changes,
            q=job.solution.q,
            target=job.target,
            gripper=job.gripper,
        )


def _waypoints(length: int) -> np.ndarray:
    """Frames looked at first: every fifth or so, both ends included, at least four."""
    count = max(4, 1 + -(-(length - 1) // _WAYPOINT_SPACING))
    return np.unique(np.linspace(0, length - 1, min(length, count)).round().astype(int))


def _largest_step(job: _Job) -> float:
    assert job.solution is not None
    return float(np.abs(np.diff(job.solution.q, axis=0)).max())
