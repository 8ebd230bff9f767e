"""MimicIKAdapter: end-effector targets in, bounded joint commands out, each with a status.

target T_base_tool ──> at most one step's worth of the way ──> solver ──> at most one joint step ──> q
                                                                  └── FK(q) against the target ──> status
"""

from __future__ import annotations

import enum
import threading
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.guidance.approach import towards
from lerobot_mimicik.guidance.branches import BranchChange
from lerobot_mimicik.guidance.closest import closest_configuration
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import joint_limits, why_not_joints, why_not_order, why_not_poses
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.kinematics.poses import PolicyFrames, decode_pose, pose_distance
from lerobot_mimicik.kinematics.poses import PoseFormat as PoseFormat
from lerobot_mimicik.solvers.base import IKSolver
from robot_adapters.arrays import float_array

if TYPE_CHECKING:
    from robot_adapters.end_effector_policy import EndEffectorPolicy

_WARM_UP = 4  # queries; the tracer optimises at the second and third
Array = NDArray[np.float64]


class IKStatus(enum.StrEnum):
    """What became of a target.

    REACHED: the command meets it within the tolerances, whoever found the command; a command that meets its
    target has no other status, but for FAILED.
    INEXACT (once called RELAXED, which still names it): it is in reach within one step, and the command comes
    near it.
    LIMITED: it is in reach, but further away than one step; the command is a step towards it, or towards
    another configuration from which it can be followed.
    UNREACHABLE: it cannot be reached from here: no configuration around the present one meets it, and the
    command goes towards the closest. One far away may: this is no statement about the whole workspace.
    FAILED: the target is no pose or cannot be one of this arm, or the solver raised an error or answered
    with no joints; the command holds.
    """

    REACHED = "reached"
    INEXACT = "inexact"
    LIMITED = "limited"
    UNREACHABLE = "unreachable"
    FAILED = "failed"
    RELAXED = INEXACT  # the former name

    @classmethod
    def _missing_(cls, value: object) -> IKStatus | None:
        return cls.INEXACT if value == "relaxed" else None


@dataclass(frozen=True)
class IKResult:
    """The answer to one target.

    Attributes:
        q: joint command [rad], (dof,), never further than the settings' `max_step` from where it started; the
            caller's own.
        status: what became of the target.
        position_error, rotation_error: between FK(q) and the target [m, rad]; NaN where the target is no pose
            of this arm.
        step: largest joint motion of the command [rad].
        source: who found the command: the solver, the descent to the closest configuration, the change to
            another branch, or hold.
        message: in words, empty when reached.
    """

    q: Array
    status: IKStatus
    position_error: float
    rotation_error: float
    step: float
    source: str
    message: str = ""


@dataclass(frozen=True)
class AdapterSettings:
    """How the adapter asks and judges.

    Attributes:
        reference: joints that a step starts from: `commanded`, the command in force, while the arm follows
            it within `resync` [rad]; `measured`, always what was measured, lag and noise included.
        max_step: largest joint motion of a command [rad].
        max_translation, max_rotation: largest part of the way that the solver is asked for at once [m, rad]. A
            MimicIK policy is besides never asked for more than it saw in training.
        position_tolerance, rotation_tolerance: errors of a target that counts as reached [m, rad].
        relaxed_position, relaxed_rotation: errors from which, for a target in reach, a step of damped least
            squares takes the place of the solver's answer [m, rad].
        resync: difference between measured and commanded joints from which the measured ones are used [rad]; an
            arm that lags by 0.2 s is 0.4 rad behind where it moves by the largest step at every frame.
        branch_distance: largest joint motion of a change to another branch of the inverse kinematics, made
            where a joint limit keeps the arm off a target that the other branch meets [rad]; 0: none is made.
        branch_detour: how much further from the target than by staying the tool may come meanwhile [m].
    """

    reference: str = "commanded"
    max_step: float = 0.095
    max_translation: float = 0.05
    max_rotation: float = 0.3
    position_tolerance: float = 0.002
    rotation_tolerance: float = 0.02
    relaxed_position: float = 0.005
    relaxed_rotation: float = 0.05
    resync: float = 0.5
    branch_distance: float = 1.5
    branch_detour: float = 0.02

    def __post_init__(self) -> None:
        if self.reference not in ("commanded", "measured"):
            raise ValueError(f"reference={self.reference!r}: expected 'commanded' or 'measured'")
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name == "branch_distance" and value == 0:
                continue
            if each.name != "reference" and not (np.isfinite(value) and value > 0):
                raise ValueError(f"{each.name} must be finite and positive, got {value}")


class MimicIKAdapter:
    """One arm's inverse kinematics as a controller needs it: stateful, bounded, and honest about the rest.

    Works with any `IKSolver`; `from_pretrained` makes it of a MimicIK checkpoint. One adapter drives one arm.
    Calls from several threads are answered one after another, each from the command in force by then.
    """

    def __init__(
        self, solver: IKSolver, description: ArmDescription, settings: AdapterSettings | None = None
    ) -> None:
        """`solver` answers for the arm of `description`; ValueError for settings that fit neither."""
        self.solver, self.description = solver, description
        self.settings = settings or AdapterSettings()
        self.chain = point_chain(description)
        self.lower, self.upper = joint_limits(description)
        self._lower_step, self._upper_step = _step_range(self.settings, solver)
        self._lock = threading.RLock()
        self._command: Array | None = None
        self._solver_knows = False  # whether the solver's history ends at the command in force
        self._branch = BranchChange(
            self.chain,
            self.lower,
            self.upper,
            self._is_reached,
            self.settings.branch_distance,
            self.settings.branch_detour,
        )

    @classmethod
    def from_pretrained(cls, path: str | Path, device: str = "cpu", **settings: Any) -> MimicIKAdapter:
        """Load a MimicIK checkpoint: a folder, a training run's output folder, or a Hub repository.

        Args:
            path: where it is.
            device: where the network runs.
            settings: of :class:`AdapterSettings`.

        Raises:
            FileNotFoundError, TypeError: if there is no checkpoint, or it is another policy's.
        """
        from lerobot_mimicik.checkpoints import load_policy
        from lerobot_mimicik.kinematics.chain import SerialArm
        from lerobot_mimicik.solvers.mimicik import MimicIKSolver

        policy = load_policy(str(path), device)
        description = policy.config.arm_description()
        solver = MimicIKSolver(SerialArm(description), policy)
        adapter = cls(solver, description, AdapterSettings(**settings))
        adapter.warm_up()
        return adapter

    def __getstate__(self) -> dict[str, Any]:
        """Without the lock: a copy for another process has its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.RLock()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of every q here."""
        return tuple(self.description.joint_names)

    def forward(self, q: ArrayLike) -> Array:
        """`T_base_tool` (7,) of joints (dof,) [rad]."""
        return self.chain.pose(np.asarray(q, dtype=float))

    def warm_up(self) -> None:
        """Answer a few queries and forget them: the first ones of a network may take a second, an arm must
        not wait for them.
        """
        middle = np.clip((self.lower + self.upper) / 2, -np.pi, np.pi)
        middle = np.where(np.isfinite(middle), middle, 0.0)
        with self._lock:
            for _ in range(_WARM_UP):
                self.solve(middle, self.forward(middle))
            self.reset()

    def reset(self) -> None:
        """Forget the past: call it when a motion starts anew."""
        with self._lock:
            self._command = None
            self._branch.cancel()

    def commanded(self, q: ArrayLike) -> None:
        """Say what was really sent [rad] (dof,), where a safety layer changed or refused the last command.

        Raises:
            ValueError: wrong shape, or not finite.
        """
        sent = self._joints(q, "the commanded joints")
        with self._lock:
            if self._command is not None:
                self._command = sent

    def solve(self, q: ArrayLike, ee_target: ArrayLike) -> IKResult:
        """The next joint command on the way to a target.

        Args:
            q: measured joints [rad], (dof,).
            ee_target: `T_base_tool` to reach, (7,), quaternion of any length but zero.

        Raises:
            ValueError: wrong shapes, or measured joints that are not finite or so far outside their limits
                that they are no joints of this arm in rad. Everything else is in the result.
        """
        measured = self._joints(q, "the measured joints")
        reason = why_not_joints(self.description, measured)
        if reason is not None:
            raise ValueError(f"the measured joints: {reason}. Expected rad, or m where a joint slides")
        target = _numbers(ee_target, "the target")
        if target.shape != (7,):
            raise ValueError(f"expected a target pose x y z qx qy qz qw, got shape {target.shape}")
        with self._lock:
            start = self._start(measured)
            result = self._answer(start, target)
            self._command = result.q.copy()
            return result

    def wrap(self, policy: Any, frames: PolicyFrames | None = None, **options: Any) -> EndEffectorPolicy:
        """A joint-space policy made of one that yields end-effector poses.

        Args:
            policy: a LeRobot policy, a function of the observation, or a client with `infer`; it may answer
                with one pose or a chunk of them.
            frames: format, reference, tool and base frame of its poses.
            options: of :class:`EndEffectorPolicy`.
        """
        from robot_adapters.end_effector_policy import EndEffectorPolicy

        return EndEffectorPolicy(self, policy, frames or PolicyFrames(), **options)

    def _joints(self, q: ArrayLike, what: str) -> Array:
        """Finite joints (dof,), a copy; ValueError for others."""
        joints = _numbers(q, what)
        if joints.shape != self.lower.shape:
            names = ", ".join(self.joint_names)
            raise ValueError(f"{what}: expected {len(self.lower)} joints ({names}), got shape {joints.shape}")
        if not np.isfinite(joints).all():
            raise ValueError(f"{what} are not finite: {joints.tolist()}")
        return joints

    def _start(self, measured: Array) -> Array:
        """Joints that this step starts from."""
        if self._command is not None and np.abs(self._command - measured).max() > self.settings.resync:
            self._command = None
        if self._command is None:
            self._solver_knows = False
        if self._command is None or self.settings.reference == "measured":
            return measured
        return self._command

    def _answer(self, start: Array, target: Array) -> IKResult:
        """`_solve` for any seven numbers and any solver."""
        try:
            if not np.isfinite(target).all():
                raise ValueError(f"the target is not finite: {target.tolist()}")
            target = decode_pose(target, PoseFormat.QUATERNION)
            reason = why_not_poses(self.description, target)
            if reason is not None:
                raise ValueError(f"the target: {reason}")
        except ValueError as error:
            return self._held(start, str(error))
        try:
            if self._solver_knows:
                return self._solve(start, target)
            self._restart(start)
            result = self._solve(start, target)
        # Solvers are anybody's: whatever they raise, the arm holds, and they begin anew with the next target.
        except Exception as error:
            self._solver_knows = False
            reason = str(error) or type(error).__name__
            return self._held(start, f"{self.solver.name}: {reason}", target)
        # Motions start near the tool: the first target tells most about its quaternion.
        hint = why_not_order(self.description, start[None], target[None])
        return result if hint is None else replace(result, message=f"{result.message}; {hint}")

    def _restart(self, q: Array) -> None:
        """The solver begins anew at `q` (dof,): its history is of another motion, or lost."""
        self._branch.cancel()
        self.solver.reset(q[None].copy() if self.solver.batched else q.copy())
        self._lower_step, self._upper_step = _step_range(self.settings, self.solver)
        self._solver_knows = True

    def _ask(self, start: Array, target: Array) -> Array:
        """The solver's joints (dof,), finite; whatever it raises, and TypeError or ValueError for others."""
        if self.solver.batched:
            answer = float_array(self.solver.solve(start[None].copy(), target[None].copy()))
            answer = answer[0] if len(answer) == 1 else answer
        else:
            answer = float_array(self.solver.solve(start.copy(), target.copy()))
        if answer.shape != start.shape:
            raise ValueError(f"answered with shape {answer.shape}, expected {len(start)} joints")
        if not np.isfinite(answer).all():
            raise ValueError(f"answered {answer.tolist()}")
        return answer

    def _solve(self, start: Array, target: Array) -> IKResult:
        settings = self.settings
        goal = self._branch.follow(target)
        if goal is not None:
            return self._changing(start, goal, target)
        here = self.forward(start)
        waypoint, share = towards(here, target, self._lower_step, self._upper_step)
        q, cut = self._within_a_step(start, self._ask(start, waypoint))
        errors = pose_distance(self.forward(q), target)
        if self._is_reached(errors):
            return self._judged(start, q, IKStatus.REACHED, target, self.solver.name, "")
        # From where the arm is, not from the answer: so that it comes to rest where it can get no closer.
        closest = closest_configuration(self.chain, self.lower, self.upper, start, target)
        best = pose_distance(self.forward(closest), target)
        other, _ = self._within_a_step(start, closest)
        if not self._is_reached(best):
            goal = self._branch.look(start, closest, target)
            if goal is not None:
                return self._changing(start, goal, target)
            # What a network says about poses outside its training is no guide to the edge of the workspace.
            message = f"from here the arm comes no closer than {best[0] * 1e3:.1f} mm, {best[1]:.3f} rad"
            return self._judged(start, other, IKStatus.UNREACHABLE, target, "descent", message)
        far = share < 1.0 or cut
        if far:
            status, message = IKStatus.LIMITED, "a step towards a target that is several steps away"
            before = self._cost(pose_distance(here, target))
            aimed_at = before - self._cost(pose_distance(waypoint, target))
            stalled = before - self._cost(errors) < 0.5 * aimed_at
        else:
            status, message = IKStatus.INEXACT, "in reach, and missed by the solver"
            stalled = errors[0] > settings.relaxed_position or errors[1] > settings.relaxed_rotation
        if stalled:
            return self._judged(start, other, status, target, "descent", message)
        return self._judged(start, q, status, target, self.solver.name, message)

    def _changing(self, start: Array, goal: Array, target: Array) -> IKResult:
        q, on_the_way = self._within_a_step(start, goal)
        if not on_the_way:
            # The solver begins anew: its history lies in the other branch.
            self._restart(q)
        message = f"a joint limit is in the way: {_step(start, goal):.2f} rad to a configuration without"
        return self._judged(start, q, IKStatus.LIMITED, target, "branch", message)

    def _judged(
        self, start: Array, q: Array, status: IKStatus, target: Array, source: str, message: str
    ) -> IKResult:
        """The result of a command `q`, which is REACHED where it meets the target, whatever was expected."""
        errors = pose_distance(self.forward(q), target)
        if self._is_reached(errors):
            status, message = IKStatus.REACHED, ""
        return IKResult(q.copy(), status, *errors, _step(start, q), source, message)

    def _held(self, start: Array, message: str, target: Array | None = None) -> IKResult:
        errors = (np.nan, np.nan) if target is None else pose_distance(self.forward(start), target)
        return IKResult(start.copy(), IKStatus.FAILED, *errors, 0.0, "hold", message)

    def _within_a_step(self, start: Array, q: Array) -> tuple[Array, bool]:
        """The command on the straight way to `q` that moves no joint further than allowed, and whether that
        cut it. Joints measured outside their limits are never pushed further out.
        """
        q = np.clip(q, np.minimum(self.lower, start), np.maximum(self.upper, start))
        step = _step(start, q)
        if step <= self.settings.max_step:
            return q, False
        return start + (q - start) * (self.settings.max_step / step), True

    def _is_reached(self, errors: tuple[float, float]) -> bool:
        return errors[0] <= self.settings.position_tolerance and errors[1] <= self.settings.rotation_tolerance

    def _cost(self, errors: tuple[float, float]) -> float:
        """Distance in tolerances, to compare errors by."""
        return errors[0] / self.settings.position_tolerance + errors[1] / self.settings.rotation_tolerance


def _step(start: Array, q: Array) -> float:
    return float(np.abs(q - start).max())


def _numbers(values: ArrayLike, what: str) -> Array:
    """A copy as floats; ValueError for what holds none."""
    try:
        return float_array(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {error}") from error


def _step_range(settings: AdapterSettings, solver: IKSolver) -> tuple[Array, Array]:
    """Smallest and largest pose step (6,) [m, rad] that the solver is asked for at once."""
    largest = np.array([settings.max_translation] * 3 + [settings.max_rotation] * 3)
    if solver.step_range is None:
        return -largest, largest
    lower, upper = solver.step_range
    # An axis that training left out must not keep targets from being approached at all.
    least = 0.1 * largest
    return -np.clip(-lower, least, largest), np.clip(upper, least, largest)
