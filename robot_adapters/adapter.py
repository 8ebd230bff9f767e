"""MimicIKAdapter: end-effector targets in, bounded joint commands out, each with a status.

target T_base_tool, upcoming ──────────────────────────────> guidance ──> q, at most one joint step away
     └── at most one step's worth of the way ──> solver ──> prior ─┘  └──> certificate ──> status
"""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.foresight.foresight import Foresight
from lerobot_mimicik.foresight.weights import is_foresight, load_weights, shipped
from lerobot_mimicik.guidance.certificate import Reason
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.plausibility import (
    joint_limits,
    why_not_joints,
    why_not_order,
    why_not_poses,
    why_not_same_arm,
)
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.kinematics.poses import PolicyFrames, decode_pose, pose_distance
from lerobot_mimicik.kinematics.poses import PoseFormat as PoseFormat
from lerobot_mimicik.solvers.base import IKSolver
from robot_adapters.adapter_settings import AdapterSettings
from robot_adapters.arrays import float_array
from robot_adapters.ik_result import IKResult, IKStatus
from robot_adapters.solver_proposals import SolverProposals

if TYPE_CHECKING:
    from robot_adapters.end_effector_policy import EndEffectorPolicy

_WARM_UP = 4  # queries; the tracer optimises at the second and third
_STATUS = {Reason.STEP: "limited", Reason.SMOOTHNESS: "inexact"}
Array = NDArray[np.float64]

_WEIGHTS = ["config.json", "*.safetensors"]  # what a checkpoint of the Hub is asked for


class MimicIKAdapter:
    """One arm's inverse kinematics as a controller needs it: stateful, bounded, and honest about the rest.

    `for_arm` needs nothing but the arm; `from_pretrained` adds what a MimicIK checkpoint has learned; any `IKSolver` may
    take its place. One adapter drives one arm.
    Calls from several threads are answered one after another, each from the command in force by then.
    """

    def __init__(
        self,
        solver: IKSolver | None,
        description: ArmDescription,
        settings: AdapterSettings | None = None,
        foresight: Foresight | None = None,
    ) -> None:
        """`solver`, or None, proposes joints for the arm of `description`; `foresight`, or None, makes trembling targets
        steady. ValueError for settings that do not fit.
        """
        self.solver, self.description = solver, description
        self.settings = settings or AdapterSettings()
        self.chain = point_chain(description)
        self.lower, self.upper = joint_limits(description)
        largest = np.array([self.settings.max_translation] * 3 + [self.settings.max_rotation] * 3)
        self._proposals = None if solver is None else SolverProposals(solver, self.chain, largest)
        self._lock = threading.RLock()
        self._command: Array | None = None
        self._solver_knows = False  # whether the solver's history ends at the command in force
        self._guidance = Guidance(arm_model(description), self.settings, foresight=foresight)

    @classmethod
    def for_arm(
        cls, arm: str | Path | ArmDescription, foresight: str | Path = "", **settings: Any
    ) -> MimicIKAdapter:
        """The guided solver alone, without any checkpoint, or with foresight.

        Args:
            arm: A shipped arm's name, a URDF file, or a description.
            foresight: Whose weights make trembling targets steady: an arm's in the package, or a checkpoint's folder;
                empty: none.
            settings: Of `AdapterSettings`.

        Raises:
            ValueError, UrdfError, FileNotFoundError: As `describe_arm`; settings out of range; as `Foresight.load`.
        """
        description = arm if isinstance(arm, ArmDescription) else describe_arm(str(arm))
        learned = Foresight.load(foresight, description) if foresight else None
        adapter = cls(None, description, AdapterSettings.of(settings), learned)
        adapter.warm_up()
        return adapter

    @classmethod
    def from_pretrained(cls, path: str | Path, device: str = "cpu", **settings: Any) -> MimicIKAdapter:
        """Load a checkpoint: weights in the package by their arm's name, a folder, a training run's output folder, a Hub
        repository, or a file of `mimicik export`, which needs neither torch nor LeRobot.

        Args:
            path: Where it is.
            device: Where the network runs.
            settings: Of `AdapterSettings`.

        Raises:
            FileNotFoundError, TypeError: If there is no checkpoint, or it is another policy's.
            ValueError, EngineUnavailable: As `StepFile.load`.
        """
        from lerobot_mimicik.checkpoints import find_checkpoint, kind_of, load_policy

        if str(path).endswith(".onnx"):
            return cls._exported(path, settings)
        folder = str(path) if str(path) in shipped() else find_checkpoint(str(path))
        if folder in shipped() or is_foresight(folder):
            return cls.for_arm(load_weights(folder).description, folder, **settings)
        from lerobot_mimicik.kinematics.chain import SerialArm
        from lerobot_mimicik.solvers.mimicik import MimicIKSolver

        policy = load_policy(str(path), device)
        if kind_of(policy.config) == "foresight":  # on the Hub, where no folder tells before it is loaded
            from huggingface_hub import snapshot_download

            return cls.from_pretrained(snapshot_download(folder, allow_patterns=_WEIGHTS), device, **settings)
        description = policy.config.arm_description()
        solver = MimicIKSolver(SerialArm(description), policy)
        adapter = cls(solver, description, AdapterSettings.of(settings))
        adapter.warm_up()
        return adapter

    @classmethod
    def _exported(cls, path: str | Path, settings: dict[str, Any]) -> MimicIKAdapter:
        from lerobot_mimicik.solvers.exported import ExportedSolver

        solver = ExportedSolver(Path(path).expanduser())
        adapter = cls(solver, solver.description, AdapterSettings.of(settings))
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

    def check_arm(self, driven: ArmDescription, source: str) -> None:
        """See that this is the inverse kinematics of an arm that is to be driven; tools may differ.

        Args:
            driven: The arm.
            source: What this was made from, for the message.

        Raises:
            ValueError: It is another arm's, even one whose joints have the same names.
        """
        reason = why_not_same_arm(self.description, driven)
        if reason is not None:
            raise ValueError(
                f"{source} is the checkpoint of another arm than the one that is driven: {reason}"
            )

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

    def commanded(self, q: ArrayLike) -> None:
        """Say what was really sent [rad] (dof,), where a safety layer changed or refused the last command.

        Raises:
            ValueError: Wrong shape, or not finite.
        """
        sent = self._joints(q, "the commanded joints")
        with self._lock:
            if self._command is not None:
                self._command = sent
                self._guidance.commanded(sent)

    def solve(self, q: ArrayLike, ee_target: ArrayLike, upcoming: ArrayLike | None = None) -> IKResult:
        """The next joint command on the way to a target.

        Args:
            q: Measured joints [rad], (dof,).
            ee_target: `T_base_tool` to reach, (7,), quaternion of any length but zero.
            upcoming: Targets of the frames after this one (T, 7), as many as are known: the motion is planned along
                them. From the first one on that is no pose of this arm they are not looked at.

        Raises:
            ValueError: Wrong shapes, or measured joints that are not finite or so far outside their limits
                that they are no joints of this arm in rad. Everything else is in the result.
        """
        measured = self._joints(q, "the measured joints")
        reason = why_not_joints(self.description, measured)
        if reason is not None:
            raise ValueError(f"the measured joints: {reason}. Expected rad, or m where a joint slides")
        target = _numbers(ee_target, "the target")
        if target.shape != (7,):
            raise ValueError(f"expected a target pose x y z qx qy qz qw, got shape {target.shape}")
        following = self._following(upcoming)
        with self._lock:
            start = self._start(measured)
            result = self._answer(start, target, following)
            self._command = result.q.copy()
            return result

    def solve_chunk(self, q: ArrayLike, ee_targets: ArrayLike) -> list[IKResult]:
        """The joint commands of consecutive targets, each planned with all that follow it in view.

        Args:
            q: Measured joints [rad] (dof,) before the first command.
            ee_targets: `T_base_tool` (T, 7), one per frame.

        Raises:
            ValueError: As `solve`.
        """
        targets = _numbers(ee_targets, "the targets")
        if targets.ndim != 2 or targets.shape[1] != 7:
            raise ValueError(f"expected target poses of shape (T, 7), got shape {targets.shape}")
        results: list[IKResult] = []
        with self._lock:
            for t, target in enumerate(targets):
                # Within a chunk the arm is taken to be where it was told to be.
                start = results[-1].q if results else q
                results.append(self.solve(start, target, targets[t + 1 :]))
        return results

    def wrap(self, policy: Any, frames: PolicyFrames | None = None, **options: Any) -> EndEffectorPolicy:
        """A joint-space policy made of one that yields end-effector poses.

        Args:
            policy: A LeRobot policy, a function of the observation, or a client with `infer`; it may answer
                with one pose or a chunk of them.
            frames: Format, reference, tool and base frame of its poses.
            options: Of `EndEffectorPolicy`.
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

    def _following(self, upcoming: ArrayLike | None) -> Array | None:
        """The known next targets (T, 7) up to the first that is no pose of this arm."""
        if upcoming is None:
            return None
        poses = _numbers(upcoming, "the upcoming targets")
        if poses.size == 0:
            return None
        if poses.ndim != 2 or poses.shape[1] != 7:
            raise ValueError(f"expected upcoming target poses of shape (T, 7), got shape {poses.shape}")
        poses = poses[: self.settings.horizon - 1]
        while len(poses):
            try:
                return self._pose(poses)
            except ValueError:
                poses = poses[:-1]
        return None

    def _pose(self, target: Array) -> Array:
        """Seven numbers, or rows of them, as poses of this arm with unit quaternions; ValueError with the reason for
        others.
        """
        if not np.isfinite(target).all():
            raise ValueError(f"the target is not finite: {target.tolist()}")
        pose = decode_pose(target, PoseFormat.QUATERNION)
        reason = why_not_poses(self.description, pose)
        if reason is not None:
            raise ValueError(f"the target: {reason}")
        return pose

    def _start(self, measured: Array) -> Array:
        """Joints that this step starts from."""
        if self._command is not None and np.abs(self._command - measured).max() > self.settings.resync:
            self._command = None
        if self._command is None:
            self._solver_knows = False
        if self._command is None or self.settings.reference == "measured":
            return measured
        return self._command

    def _answer(self, start: Array, target: Array, upcoming: Array | None) -> IKResult:
        """`_solve` for any seven numbers and any solver."""
        try:
            target = self._pose(target)
        except ValueError as error:
            return self._held(start, str(error))
        try:
            if self._solver_knows:
                return self._solve(start, target, upcoming)
            self._restart(start)
            result = self._solve(start, target, upcoming)
        # Solvers are anybody's: whatever they raise, the arm holds, and they begin anew with the next target.
        except Exception as error:
            self._solver_knows = False
            reason = str(error) or type(error).__name__
            return self._held(start, f"{self._name}: {reason}", target)
        # Motions start near the tool: the first target tells most about its quaternion.
        hint = why_not_order(self.description, start[None], target[None])
        return result if hint is None else replace(result, message=f"{result.message}; {hint}")

    @property
    def _name(self) -> str:
        return self.solver.name if self.solver is not None else "guided"

    def _restart(self, q: Array) -> None:
        """Guidance and solver begin anew at `q` (dof,): their history is of another motion, or lost."""
        self._guidance.reset(q)
        if self._proposals is not None:
            self._proposals.restart(q)
        self._solver_knows = True

    def _solve(self, start: Array, target: Array, upcoming: Array | None) -> IKResult:
        prior = None if self._proposals is None else self._proposals.towards
        solution = self._guidance.solve(start, target, upcoming, prior)
        found = solution.certificate
        if solution.changing and self._proposals is not None:
            # The solver begins anew: its history lies in the other branch.
            self._proposals.restart(solution.q)
        source = self._name if found.source == "prior" else found.source
        if found.reached:
            status, message = IKStatus.REACHED, str(found)
        elif solution.changing:
            status, message = (
                IKStatus.LIMITED,
                "a joint limit is in the way: going to a configuration without",
            )
        else:
            status, message = IKStatus(_STATUS.get(found.reason, "unreachable")), str(found)
        errors = (found.position_error, found.rotation_error)
        return IKResult(solution.q.copy(), status, *errors, _step(start, solution.q), source, message, found)

    def _held(self, start: Array, message: str, target: Array | None = None) -> IKResult:
        errors = (np.nan, np.nan) if target is None else pose_distance(self.forward(start), target)
        return IKResult(start.copy(), IKStatus.FAILED, *errors, 0.0, "hold", message)


def _step(start: Array, q: Array) -> float:
    return float(np.abs(q - start).max())


def _numbers(values: ArrayLike, what: str) -> Array:
    """A copy as floats; ValueError for what holds none."""
    try:
        return float_array(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {error}") from error
