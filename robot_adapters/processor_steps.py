"""LeRobot processor steps with MimicIK inside, for the checkpoint of an end-effector policy.

`JointsToEEState` and `EEActionToJoints` go before and after the policy, so that it drives a joint-space robot: see
`robot_adapters.wrapping`. None of these is in LeRobot's registry: they are found by their import path, also where
plugins are not imported. `MimicIKEEToJoints`, the step of a robot's pipeline, is here for users' imports.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    ObservationProcessorStep,
    RelativeActionsProcessorStep,
)
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.poses import IDENTITY, PolicyFrames, PoseFormat
from lerobot_mimicik.weights import load_tensors
from robot_adapters.adapter import AdapterSettings, IKResult, MimicIKAdapter
from robot_adapters.ee_to_joints import MimicIKEEToJoints as MimicIKEEToJoints
from robot_adapters.joint_units import check_joints, check_rad_or_deg, to_rad

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


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

        check_rad_or_deg(self.joint_units)
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
        joints = numbers[..., :dof].reshape(-1, dof) * to_rad(self.joint_units)
        check_joints(self._description, joints, self.joint_units)
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

        check_rad_or_deg(self.joint_units)
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
        q = np.stack([result.q for result in results]) / to_rad(self.joint_units)
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
