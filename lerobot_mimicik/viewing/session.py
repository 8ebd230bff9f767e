"""What happens while somebody plays with an arm: a target, solvers that follow it, and how each of them does.

Nothing here knows of a page. `PlaySession.tick` is one control frame; every solver drives an arm of its own in closed
loop: its command is where its arm is at the next frame.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.evaluation.metrics import jerk_of
from lerobot_mimicik.guidance.certificate import Reason, at_limits, is_singular, smallest_singular
from lerobot_mimicik.guidance.model import ArmModel, arm_model
from lerobot_mimicik.guidance.orientation import service
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.tremor import displaced, tremor
from lerobot_mimicik.solvers.base import Array, IKSolver
from lerobot_mimicik.solvers.iterative import MAX_STEP
from lerobot_mimicik.viewing.motions import FPS, Motion

DRAG = "Drag the target"
REACHED, JUMPED, FAILED = "reached", "jumped", "failed"
"""Statuses beside the values of `Reason`."""
MOST_TREMOR_MM = 3.0

_SECONDS = 1.0  # that jerk, largest step and time per answer are of
_TREMOR_S = 30.0  # after which a tremor repeats itself
_TOLERANCES = GuidanceSettings()
_NEAR_BOUND = 0.94  # of `MAX_STEP`: the guided solver's own bound is 0.095 rad


@dataclass(frozen=True)
class Reading:
    """How a solver does.

    Attributes:
        status: `reached`, `jumped` (a joint moved by more than 0.1 rad at once), `failed`, or what is in the way: a
            value of `Reason`.
        detail: Why it failed; else empty.
        position_mm, rotation_deg: Error of its command against the target, tremor included.
        margins: Distance of every joint to its nearer limit as a fraction of half its range, (dof,): 1 in the middle,
            negative outside; 1 for joints without limits.
        singular_value: Smallest singular value of the Jacobian, rotations by the arm's lever [m/rad].
        step: Largest joint step of the last second [rad].
        jerk: Root mean square of the third differences of the last second [rad/s^3].
        milliseconds: Median time per answer of the last second.
    """

    status: str
    detail: str
    position_mm: float
    rotation_deg: float
    margins: tuple[float, ...]
    singular_value: float
    step: float
    jerk: float
    milliseconds: float


class Player:
    """A solver, the arm that it drives, and what is known of the last second.

    Attributes:
        q: Joints of its arm (dof,) [rad, m].
        reading: How it did in the last frame; None before the first.
    """

    def __init__(self, solver: IKSolver, model: ArmModel, q: Array, fps: float) -> None:
        self.solver, self.model = solver, model
        # An arm that cannot serve every orientation reaches a target with its position, as the adapter says.
        self._turn_counts = not service(model, _TOLERANCES).position_first
        self.reset(q, fps)

    def reset(self, q: Array, fps: float) -> None:
        """The arm is at rest at `q` (dof,), and the past is forgotten."""
        self.q, self.fps = np.array(q, dtype=float), fps
        frames = round(_SECONDS * fps)
        self._commands: deque[Array] = deque([self.q], maxlen=frames + 3)
        self._times: deque[float] = deque(maxlen=frames)
        self.reading: Reading | None = None
        self.solver.reset_one(self.q)

    def follow(self, target: Array, upcoming: Array | None) -> None:
        """One frame; a solver that raises, or whose answer is not finite, leaves its arm where it is."""
        began = time.perf_counter()
        command, failure = self._ask(target, upcoming)
        self._times.append(1e3 * (time.perf_counter() - began))
        before, self.q = self.q, command
        self._commands.append(command)
        self.reading = self._read(before, target, failure)

    def _ask(self, target: Array, upcoming: Array | None) -> tuple[Array, str]:
        try:
            if upcoming is not None and self.solver.look_ahead:
                self.solver.foresee(upcoming[: self.solver.look_ahead])
            command = self.solver.solve_one(self.q, target)
        except Exception as error:  # whatever a library raises, the others play on
            return self.q, str(error) or type(error).__name__
        command = np.array(command, dtype=float)
        if command.shape != self.q.shape or not np.isfinite(command).all():
            return self.q, "its answer is not finite"
        return command, ""

    def _read(self, before: Array, target: Array, failure: str) -> Reading:
        pose = self.model.pose(self.q)
        turn = (Rotation.from_quat(target[3:]) * Rotation.from_quat(pose[3:]).inv()).as_rotvec()
        left = np.concatenate([target[:3] - pose[:3], turn])
        commands = np.array(self._commands)
        steps = np.abs(np.diff(commands, axis=0))
        jerk = jerk_of(commands) * self.fps**3
        return Reading(
            status=FAILED if failure else self._status(before, left),
            detail=failure,
            position_mm=1e3 * float(np.linalg.norm(left[:3])),
            rotation_deg=float(np.degrees(np.linalg.norm(turn))),
            margins=tuple(_margins(self.model, self.q).tolist()),
            singular_value=smallest_singular(self.model, self.q)[0],
            step=float(steps.max()) if steps.size else 0.0,
            jerk=float(np.sqrt((jerk**2).mean())) if jerk.size else 0.0,
            milliseconds=float(np.median(self._times)),
        )

    def _status(self, before: Array, left: Array) -> str:
        step = float(np.abs(self.q - before).max())
        if step > MAX_STEP + 1e-9:
            return JUMPED
        position = np.linalg.norm(left[:3])
        rotation = np.linalg.norm(left[3:]) if self._turn_counts else 0.0
        if position <= _TOLERANCES.position_tolerance and rotation <= _TOLERANCES.rotation_tolerance:
            return REACHED
        if step >= _NEAR_BOUND * MAX_STEP:
            return Reason.STEP.value
        if at_limits(self.model, self.q).any():
            return Reason.LIMIT.value
        if is_singular(self.model, self.q, left):
            return Reason.SINGULAR.value
        return "off target"


class PlaySession:
    """A target, and solvers that follow it side by side.

    Attributes:
        description, model: The arm, with a home.
        motions: What can be followed beside `DRAG`, by name.
        offered: Names of the solvers that can be chosen.
        players: Those that were, by name, in the order in which they were chosen.
        refused: Why a chosen solver could not be made, by name.
        motion: Name of the motion that is followed, or `DRAG`.
        moving: Whether the motion goes on.
        tremor_mm: Root mean square of the trembling added to the target [mm]; half a degree per mm goes with it.
        target: The pose that solvers are asked for, (7,).
        clean: The same without tremor.
        upcoming: The targets after it, (T, 7); None while it is dragged.
        frame: Number of frames since the motion began.
        fps: Frames per second.
    """

    def __init__(
        self,
        description: ArmDescription,
        solvers: Mapping[str, Callable[[], IKSolver]],
        motions: Sequence[Motion] = (),
        seed: int = 0,
    ) -> None:
        """
        Args:
            description: The arm.
            solvers: What makes each solver that is offered, by name.
            motions: What is offered to follow.
            seed: Of the tremor.

        Raises:
            ValueError: The description has no home.
        """
        if not description.home:
            raise ValueError("an arm to play with needs a home: data.home.with_home finds one")
        self.description, self.model = description, arm_model(description)
        self.motions = {motion.name: motion for motion in motions}
        self.offered, self._makers = tuple(solvers), dict(solvers)
        self.players: dict[str, Player] = {}
        self.refused: dict[str, str] = {}
        self.motion, self.moving, self.frame, self.fps = DRAG, True, 0, FPS
        self.tremor_mm = 0.0
        self._seed, self._tremors = seed, 0
        self._home = np.array(description.home)
        self._dragged = self.model.pose(self._home)
        self._shake()
        self.target = self.clean = self._dragged
        self.upcoming: Array | None = None

    @property
    def start(self) -> Array:
        """Joints (dof,) that the arms begin at."""
        motion = self.motions.get(self.motion)
        return self._home if motion is None else motion.start

    def choose(self, names: Sequence[str]) -> None:
        """Let these solvers follow the target; one that is new begins where the first one is.

        Raises:
            ValueError: One of them is not offered.
        """
        unknown = [name for name in names if name not in self.offered]
        if unknown:
            raise ValueError(f"unknown solver {unknown[0]!r}; offered are {', '.join(self.offered)}")
        here = next(iter(self.players.values())).q if self.players else self.start
        players = {}
        for name in dict.fromkeys(names):
            player = self.players.get(name) or self._made(name, here)
            if player is not None:
                players[name] = player
        self.players = players

    def follow(self, name: str) -> None:
        """Follow a motion from its beginning, or `DRAG`: the target stays where it is until it is dragged.

        Raises:
            ValueError: There is no such motion.
        """
        if name != DRAG and name not in self.motions:
            raise ValueError(f"unknown motion {name!r}; there are {', '.join([DRAG, *self.motions])}")
        self._dragged = self.clean
        self.motion, self.frame = name, 0
        fps = self.motions[name].fps if name != DRAG else FPS
        if fps != self.fps:
            self.fps = fps
            self._shake()
        if name != DRAG:
            self._rest_at(self.start)

    def move_target(self, pose: Sequence[float] | Array) -> None:
        """Put the target to `T_base_tool` (7,), x y z qx qy qz qw; a motion that is followed ends.

        Raises:
            ValueError: It is no pose.
        """
        pose = np.array(pose, dtype=float)
        length = float(np.linalg.norm(pose[3:]))
        if pose.shape != (7,) or not np.isfinite(pose).all() or length < 1e-6:
            raise ValueError(f"a target has 7 finite numbers x y z qx qy qz qw, not {pose.tolist()}")
        pose[3:] /= length
        if self.motion != DRAG:
            self.follow(DRAG)
        self._dragged = pose

    def restart(self) -> None:
        """Everything begins anew: the motion, or the arms and the target at home."""
        self.frame = 0
        if self.motion == DRAG:
            self._dragged = self.model.pose(self._home)
        self._rest_at(self.start)

    def tick(self) -> None:
        """One frame: the target moves on and every solver follows it."""
        self.clean, self.upcoming = self._next()
        twist = self._twist[self._tremors % len(self._twist)] * self.tremor_mm
        self.target = displaced(self.clean[None], twist[None])[0]
        if self.upcoming is not None and self.tremor_mm:
            ahead = (self._tremors + 1 + np.arange(len(self.upcoming))) % len(self._twist)
            self.upcoming = displaced(self.upcoming, self._twist[ahead] * self.tremor_mm)
        self._tremors += 1
        for player in self.players.values():
            player.follow(self.target, self.upcoming)

    def _next(self) -> tuple[Array, Array | None]:
        """This frame's target without tremor, and those after it where they are known."""
        motion = self.motions.get(self.motion)
        if motion is None:
            return self._dragged, None
        if not self.moving:
            return self.clean, None
        if self.frame >= len(motion.targets):
            self.frame = 0
            # A recording ends elsewhere than it began.
            if np.linalg.norm(motion.targets[-1, :3] - motion.targets[0, :3]) > 0.01:
                self._rest_at(motion.start)
        at, self.frame = self.frame, self.frame + 1
        longest = max((player.solver.look_ahead for player in self.players.values()), default=0)
        return motion.targets[at], motion.targets[at + 1 : at + 1 + longest]

    def _made(self, name: str, q: Array) -> Player | None:
        try:
            player = Player(self._makers[name](), self.model, q, self.fps)
            # The first answer compiles, traces or loads.
            player.follow(self.model.pose(q), None)
            player.reset(q, self.fps)
        except Exception as error:  # a peer's library may raise anything; the page says what
            self.refused[name] = str(error) or type(error).__name__
            return None
        self.refused.pop(name, None)
        return player

    def _rest_at(self, q: Array) -> None:
        for player in self.players.values():
            player.reset(q, self.fps)

    def _shake(self) -> None:
        """A tremor of 1 mm that repeats itself without a seam."""
        frames = round(_TREMOR_S * self.fps)
        self._twist = tremor(frames, self.fps, 1.0, np.random.default_rng(self._seed))


def _margins(model: ArmModel, q: Array) -> Array:
    half = (model.upper - model.lower) / 2
    nearer = np.minimum(q - model.lower, model.upper - q)
    ratio = np.divide(nearer, half, out=np.ones_like(q), where=np.isfinite(half) & (half > 0))
    return np.where(np.isfinite(half), ratio, 1.0)
