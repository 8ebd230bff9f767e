"""LeRobot processor steps with MimicIK inside.

`MimicIKEEToJoints` stands where LeRobot's `InverseKinematicsEEToJoints` does, between a pose and a robot that
takes joints. `JointsToEEState` and `EEActionToJoints` go into the checkpoint of an end-effector policy, before
and after it, so that it drives a joint-space robot: see `robot_adapters.wrapping`. None of these is in LeRobot's
registry: they are found by their import path, also where plugins are not imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, RobotAction, TransitionKey
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    ObservationProcessorStep,
    RelativeActionsProcessorStep,
    RobotActionProcessorStep,
)
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import check_plausible
from lerobot_mimicik.kinematics.poses import IDENTITY, PolicyFrames, PoseFormat
from lerobot_mimicik.weights import load_tensors
from robot_adapters.adapter import AdapterSettings, IKResult, MimicIKAdapter
from robot_adapters.kinematics import MimicIKKinematics

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
_POSE = ("x", "y", "z", "wx", "wy", "wz")
_LONGEST_TURN = 4 * np.pi
"""rad: no rotation needs a vector longer than half a turn, sums of small turns reach some; degrees exceed it."""


@dataclass
class MimicIKEEToJoints(RobotActionProcessorStep):
    """`ee.x .. ee.wz` (position in m, rotation vector in rad) and `ee.gripper_pos` to `<joint>.pos`.

    The contract of `InverseKinematicsEEToJoints`, and its keywords, but: joints are taken by name, in any order; the
    gripper may have any name, or be absent; joints are in radians or degrees; and `result` says what became of the pose.

    Attributes:
        adapter: The arm's inverse kinematics.
        motor_names: The robot's motors, in its order; those that are not the arm's joints pass through (one
            gripper at most).
        joint_units: `rad` or `deg`, of the robot; it has no default but with `MimicIKKinematics`, which counts in
            degrees.
        kinematics: In place of `adapter`: the same, or the arm's `MimicIKKinematics`.
        initial_guess_current_joints: LeRobot's keyword for the joints that a step starts from: True sets the
            adapter's `reference` to `measured`, False to `commanded`; None leaves it.
        orientation_weight: LeRobot's keyword; 0 leaves the orientation free, with `MimicIKKinematics` alone.
        result: What became of the last pose; None before.
    """

    adapter: MimicIKAdapter = None  # type: ignore[assignment]
    motor_names: list[str] = field(default_factory=list)
    joint_units: str = ""
    kinematics: MimicIKAdapter | MimicIKKinematics | None = None
    initial_guess_current_joints: bool | None = None
    orientation_weight: float = 0.01
    result: IKResult | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.kinematics, MimicIKKinematics):
            self.kinematics = self.kinematics.make_adapter(self.orientation_weight)
            self.joint_units = self.joint_units or "deg"
        given = [each for each in (self.adapter, self.kinematics) if each is not None]
        if len(given) != 1 or not isinstance(given[0], MimicIKAdapter):
            found = " and ".join(type(each).__name__ for each in given) or "none"
            raise TypeError(
                f"expected one MimicIKAdapter as adapter (or kinematics), got {found}; "
                "MimicIKAdapter.from_pretrained(checkpoint) or MimicIKAdapter.for_arm(arm) makes one, "
                "robot_adapters.kinematics.MimicIKKinematics(urdf) does as well, and placo is not needed"
            )
        self.adapter = self.kinematics = given[0]
        if self.initial_guess_current_joints is not None:
            reference = "measured" if self.initial_guess_current_joints else "commanded"
            self.adapter.settings = replace(self.adapter.settings, reference=reference)
        missing = [name for name in self.adapter.joint_names if name not in self.motor_names]
        others = [name for name in self.motor_names if name not in self.adapter.joint_names]
        if missing or len(others) > 1:
            raise ValueError(
                f"the checkpoint drives {list(self.adapter.joint_names)}; motor_names {self.motor_names} lack "
                f"{missing} and have {others} besides (expected one gripper at most)"
            )
        _check_units(self.joint_units)
        self._gripper = others[0] if others else None

    def action(self, action: RobotAction) -> RobotAction:
        """Replaces the pose by joints.

        Raises:
            KeyError: A number of the pose, or a joint of the observation, is missing.
            ValueError: Joints or a rotation that are in another unit, as far as that can be seen.
        """
        keys = [f"ee.{name}" for name in _POSE] + (["ee.gripper_pos"] if self._gripper else [])
        missing = [key for key in keys if action.get(key) is None]
        if missing:
            raise KeyError(f"the action lacks {missing}; it has {sorted(action)}")
        observation = self.transition.get(TransitionKey.OBSERVATION) or {}
        joints = [f"{name}.pos" for name in self.adapter.joint_names]
        if any(key not in observation for key in joints):
            raise KeyError(
                f"the observation has {sorted(observation)}; expected the measured joints {joints}"
            )
        to_rad = _to_rad(self.joint_units)
        measured = np.array([float(observation[key]) for key in joints]) * to_rad
        _check_joints(self.adapter.description, measured, self.joint_units)
        numbers = [float(action.pop(key)) for key in keys]
        if np.linalg.norm(numbers[3:6]) > _LONGEST_TURN:
            raise ValueError(f"ee.wx, ee.wy, ee.wz are {numbers[3:6]}: expected a rotation vector in rad")
        frames = PolicyFrames(form=PoseFormat.ROTATION_VECTOR)
        target = frames.from_policy(numbers[:6], self.adapter.forward(measured))
        self.result = self.adapter.solve(measured, target)
        q = self.result.q / to_rad
        for name in self.motor_names:
            if name == self._gripper:
                action[f"{name}.pos"] = numbers[6]
            else:
                action[f"{name}.pos"] = float(q[self.adapter.joint_names.index(name)])
        return action

    def transform_features(self, features: Features) -> Features:
        """Pose features out, joint features in."""
        for name in (*_POSE, "gripper_pos"):
            features[PipelineFeatureType.ACTION].pop(f"ee.{name}", None)
        for name in self.motor_names:
            features[PipelineFeatureType.ACTION][f"{name}.pos"] = PolicyFeature(FeatureType.ACTION, (1,))
        return features

    def reset(self) -> None:
        """Forget the past."""
        self.adapter.reset()
        self.result = None


@dataclass(kw_only=True)
class JointsToEEState(ObservationProcessorStep, RelativeActionsProcessorStep):
    """The state of a joint-space robot as an end-effector policy saw it in training.

    Keeps the last measured joints for `EEActionToJoints`, which is in the other pipeline. LeRobot connects the
    two when it loads them (`make_pre_post_processors`), since they are a pair of relative and absolute actions
    to it; the conversion of those is off.

    Attributes:
        arm: The arm's description, as JSON.
        joint_units: `rad` or `deg`, of the robot.
        rotation: Format of the policy's poses.
        tool: The policy's tool in the arm's tool frame (7,); empty: the same.
        state_keys: The keys that the policy finds its state under.
        link: In older checkpoints only, without effect.
    """

    _registry_name: ClassVar[str | None] = None  # found by import path, not as LeRobot's own step
    arm: str
    joint_units: str
    rotation: str = PoseFormat.QUATERNION.value
    tool: list[float] = field(default_factory=list)
    state_keys: list[str] = field(default_factory=lambda: [OBS_STATE])
    link: str = ""

    def __post_init__(self) -> None:
        from lerobot_mimicik.kinematics.array_chain import array_chain

        _check_units(self.joint_units)
        keys = self.state_keys if isinstance(self.state_keys, list) else []
        if not keys or any(key not in (OBS_STATE, OBS_ENV_STATE) for key in keys):
            raise ValueError(
                f"state_keys={self.state_keys!r}: expected {OBS_STATE}, {OBS_ENV_STATE}, or both"
            )
        self._measured: NDArray[np.float64] | None = None
        try:
            self._description = ArmDescription.from_json(self.arm)
        except (TypeError, ValueError) as error:
            raise ValueError(f"arm: expected an arm's description as JSON: {error}") from error
        self._chain = array_chain(self._description)
        self._frames = make_frames(self.rotation, self.tool)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Replaces joints (and gripper) by the pose (and gripper).

        Raises:
            KeyError, ValueError: There is no state, or it has the wrong size or unit.
        """
        if OBS_STATE not in observation:
            raise KeyError(f"the observation has no {OBS_STATE!r}; it has {sorted(observation)}")
        state: Tensor = observation.pop(OBS_STATE)
        dof = self._chain.dof
        if state.shape[-1] not in (dof, dof + 1):
            raise ValueError(
                f"{OBS_STATE}: expected {dof} joints, or these and a gripper, got {tuple(state.shape)}"
            )
        numbers = state.detach().double().cpu().numpy()
        joints = numbers[..., :dof].reshape(-1, dof) * _to_rad(self.joint_units)
        _check_joints(self._description, joints, self.joint_units)
        pose = self._frames.to_policy(self._chain.pose(joints)).reshape(*numbers.shape[:-1], -1)
        self._measured = joints[-1]
        seen = np.concatenate([pose, numbers[..., dof:]], axis=-1)
        given = torch.as_tensor(seen, dtype=state.dtype, device=state.device)
        return observation | dict.fromkeys(self.state_keys, given)

    def take_joints(self) -> NDArray[np.float64] | None:
        """The joints (dof,) [rad] of the last observation, once; None if there was none since."""
        joints, self._measured = self._measured, None
        return joints

    def reset(self) -> None:
        """Forget the past."""
        self._measured = None

    def get_config(self) -> dict[str, Any]:
        """What the checkpoint stores."""
        return {
            "arm": self.arm,
            "joint_units": self.joint_units,
            "rotation": self.rotation,
            "tool": self.tool,
            "state_keys": self.state_keys,
        }

    def transform_features(self, features: Features) -> Features:
        """The policy's features stay what they were in training."""
        return features


class StateAsEnvironment(ObservationProcessorStep):
    """Gives a low-dimensional policy the state as environment state too, as it was in its training data.

    LeRobot's policies without cameras ask for an environment state, and its robots have none.
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Copies the state; KeyError without one."""
        if OBS_STATE not in observation:
            raise KeyError(f"the observation has no {OBS_STATE!r}; it has {sorted(observation)}")
        return observation | {OBS_ENV_STATE: observation[OBS_STATE]}

    def transform_features(self, features: Features) -> Features:
        """The policy's features stay what they were in training."""
        return features


@dataclass(kw_only=True)
class EEActionToJoints(AbsoluteActionsProcessorStep):
    """Poses that a policy answered with to joint commands; the MimicIK weights are this step's state.

    A chunk (1, T, d), as LeRobot's real-time chunking hands it over, is planned with all its poses in view. LeRobot's
    asynchronous inference hands its chunks over pose by pose: each starts from the command before it, and nothing
    is known of the next. After a chunk of either kind, which is carried out while the policy thinks, it is not known
    which command is in force when the next observation comes: the next chunk starts from the measured joints.

    Attributes:
        policy: The MimicIK policy's configuration.
        joint_units: `rad` or `deg`, of the robot.
        rotation, tool: As in `JointsToEEState`.
        settings: Of the adapter.
        link: In older checkpoints only, without effect.
        relative_step: The `JointsToEEState` of the same policy; LeRobot sets it.
        adapter: The inverse kinematics, ready once the weights are loaded.
        result: What became of the last pose; None before.
    """

    _registry_name: ClassVar[str | None] = None  # found by import path, not as LeRobot's own step
    policy: dict[str, Any]
    joint_units: str
    rotation: str = PoseFormat.QUATERNION.value
    tool: list[float] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    link: str = ""
    result: IKResult | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        from lerobot_mimicik.configuration_mimicik import MimicIKConfig
        from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

        _check_units(self.joint_units)
        for name in ("policy", "settings"):
            if not isinstance(getattr(self, name), Mapping):
                what = "the entries of a MimicIK configuration" if name == "policy" else "names and values"
                raise ValueError(f"{name}={getattr(self, name)!r}: expected {what}")
        self._policy = MimicIKPolicy(MimicIKConfig(**self.policy)).eval()
        self._frames = make_frames(self.rotation, self.tool)
        self.adapter = self._make_adapter()
        self._last: NDArray[np.float64] | None = None
        self._answered = 0  # commands since the last observation

    def _make_adapter(self) -> MimicIKAdapter:
        from lerobot_mimicik.kinematics.chain import SerialArm
        from lerobot_mimicik.solvers.mimicik import MimicIKSolver

        description = self._policy.config.arm_description()
        solver = MimicIKSolver(SerialArm(description), self._policy)
        return MimicIKAdapter(solver, description, AdapterSettings.of(self.settings))

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Replaces the action, shape (d,), (B, d) or (B, T, d) with B = 1.

        Raises:
            RuntimeError: No observation has passed `JointsToEEState` before, or it is not connected.
            ValueError: Several actions at once, or a wrong size.
        """
        action = transition.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            raise ValueError(f"expected an action tensor, got {type(action).__name__}")
        rows = action.reshape(-1, action.shape[-1]).detach().double().cpu().numpy()
        if action.ndim > 1 and action.shape[0] != 1:
            raise ValueError(f"one arm at a time: got a batch of {action.shape[0]}")
        answers = torch.as_tensor(self._solve(rows), dtype=action.dtype)
        changed = transition.copy()
        changed[TransitionKey.ACTION] = answers.reshape(*action.shape[:-1], -1).to(action.device)
        return changed

    def _solve(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joints and grippers (T, dof or dof + 1) of consecutive poses and grippers."""
        if not isinstance(self.relative_step, JointsToEEState):
            raise RuntimeError(
                "the postprocessor is not connected to its preprocessor: load the two together, with LeRobot's "
                "make_pre_post_processors"
            )
        taken = self.relative_step.take_joints()
        if taken is not None:
            if self._answered > 1:
                self.adapter.reset()
            self._last, self._answered = taken, 0
        if self._last is None:
            raise RuntimeError("no joints yet: an observation must pass the preprocessor before an action")
        width = self._frames.form.width
        if rows.shape[1] not in (width, width + 1):
            raise ValueError(
                f"expected a pose of {width} numbers, with or without a gripper, got {rows.shape[1]}"
            )
        pose = self.adapter.forward(self._last)
        targets = np.stack([self._target(row, pose) for row in rows[:, :width]])
        results = self.adapter.solve_chunk(self._last, targets)
        self.result = results[-1]
        self._last, self._answered = self.result.q, self._answered + len(results)
        q = np.stack([result.q for result in results]) / _to_rad(self.joint_units)
        return np.concatenate([q, rows[:, width:]], axis=1)

    def _target(self, numbers: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            return self._frames.from_policy(numbers, pose)
        except ValueError:
            return np.full(7, np.nan)  # no rotation: the adapter holds and says so

    def get_config(self) -> dict[str, Any]:
        """What the checkpoint stores beside the weights."""
        return {
            "policy": self.policy,
            "joint_units": self.joint_units,
            "rotation": self.rotation,
            "tool": self.tool,
            "settings": self.settings,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """The MimicIK weights."""
        return {name: value.contiguous() for name, value in self._policy.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Loads the weights, strictly, with how far targets were from the tool in training; warms up.

        Raises:
            CheckpointError: A tensor is missing, surplus, misshapen or not finite; it names it.
        """
        load_tensors(self._policy, state, "the weights of EEActionToJoints")
        self.adapter = self._make_adapter()
        self.adapter.warm_up()

    def reset(self) -> None:
        """Forget the past."""
        if isinstance(self.relative_step, JointsToEEState):
            self.relative_step.reset()
        self.adapter.reset()
        self._last, self._answered, self.result = None, 0, None

    def transform_features(self, features: Features) -> Features:
        """Not known to the policy's pipeline."""
        return features


def make_frames(rotation: str, tool: list[float]) -> PolicyFrames:
    """Absolute poses in a rotation format, with a tool frame; an empty one is the arm's own."""
    return PolicyFrames(form=PoseFormat(rotation), tool=tool or tuple(IDENTITY))


def _check_units(joint_units: str) -> None:
    if joint_units not in ("rad", "deg"):
        raise ValueError(
            f"joint_units={joint_units!r}: expected 'rad' or 'deg', the unit of the robot's joints (airbot_play: "
            "rad; most of LeRobot's robots: deg)"
        )


def _to_rad(joint_units: str) -> float:
    return np.pi / 180 if joint_units == "deg" else 1.0


def _check_joints(description: ArmDescription, joints: NDArray[np.float64], joint_units: str) -> None:
    remedy = f"joint_units is {joint_units!r}; set it to the unit of the robot, 'rad' or 'deg'"
    check_plausible(description, joints, what="the measured joints", joints_remedy=remedy)
