"""LeRobot processor steps with MimicIK inside.

`MimicIKEEToJoints` stands where LeRobot's `InverseKinematicsEEToJoints` does, between a pose and a robot that
takes joints. `JointsToEEState` and `EEActionToJoints` go into the checkpoint of an end-effector policy, before
and after it, so that it drives a joint-space robot: see `robot_adapters.wrapping`. None of these is in LeRobot's
registry: they are found by their import path, also where plugins are not imported.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, RobotAction, TransitionKey
from lerobot.processor import ObservationProcessorStep, ProcessorStep, RobotActionProcessorStep
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.poses import IDENTITY, PolicyFrames, PoseFormat
from lerobot_mimicik.weights import load_tensors
from robot_adapters.adapter import AdapterSettings, IKResult, MimicIKAdapter

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]
_POSE = ("x", "y", "z", "wx", "wy", "wz")


@dataclass
class MimicIKEEToJoints(RobotActionProcessorStep):
    """`ee.x .. ee.wz` (position in m, rotation vector in rad) and `ee.gripper_pos` to `<joint>.pos`.

    The contract of `InverseKinematicsEEToJoints`, but: joints are taken by name, in any order; the gripper may
    have any name, or be absent; joints are in radians or degrees; and `result` says what became of the pose.

    Attributes:
        adapter: the arm's inverse kinematics.
        motor_names: the robot's motors, in its order; those that are not the arm's joints pass through (one
            gripper at most).
        joint_units: `rad` or `deg`, of the robot.
        result: what became of the last pose; None before.
    """

    adapter: MimicIKAdapter
    motor_names: list[str]
    joint_units: str = "deg"
    result: IKResult | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        missing = [name for name in self.adapter.joint_names if name not in self.motor_names]
        others = [name for name in self.motor_names if name not in self.adapter.joint_names]
        if missing or len(others) > 1:
            raise ValueError(
                f"the checkpoint drives {list(self.adapter.joint_names)}; motor_names {self.motor_names} lack "
                f"{missing} and have {others} besides (expected one gripper at most)"
            )
        if self.joint_units not in ("rad", "deg"):
            raise ValueError(f"joint_units={self.joint_units!r}: expected 'rad' or 'deg'")
        self._gripper = others[0] if others else None

    def action(self, action: RobotAction) -> RobotAction:
        """Replaces the pose by joints.

        Raises:
            KeyError: a number of the pose, or a joint of the observation, is missing.
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
        to_rad = np.pi / 180 if self.joint_units == "deg" else 1.0
        measured = np.array([float(observation[key]) for key in joints]) * to_rad
        numbers = [float(action.pop(key)) for key in keys]
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


@dataclass
class JointsToEEState(ObservationProcessorStep):
    """The state of a joint-space robot as an end-effector policy saw it in training.

    Keeps the last measured joints for `EEActionToJoints`, which is in the other pipeline: `latest`.
    """

    arm: str
    joint_units: str = "rad"
    rotation: str = PoseFormat.QUATERNION.value
    tool: list[float] = field(default_factory=list)
    state_keys: list[str] = field(default_factory=lambda: [OBS_STATE])
    latest: ClassVar[dict[str, NDArray[np.float64]]] = {}
    link: str = "ik"

    def __post_init__(self) -> None:
        from lerobot_mimicik.kinematics.array_chain import array_chain

        self._description = ArmDescription.from_json(self.arm)
        self._chain = array_chain(self._description)
        self._frames = make_frames(self.rotation, self.tool)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Replaces joints (and gripper) by the pose (and gripper).

        Raises:
            KeyError, ValueError: there is no state, or it has the wrong size.
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
        joints = numbers[..., :dof].reshape(-1, dof) * (np.pi / 180 if self.joint_units == "deg" else 1.0)
        pose = self._frames.to_policy(self._chain.pose(joints)).reshape(*numbers.shape[:-1], -1)
        self.latest[self.link] = joints[-1]
        seen = np.concatenate([pose, numbers[..., dof:]], axis=-1)
        given = torch.as_tensor(seen, dtype=state.dtype, device=state.device)
        return observation | dict.fromkeys(self.state_keys, given)

    def get_config(self) -> dict[str, Any]:
        """What the checkpoint stores."""
        return {
            "arm": self.arm,
            "joint_units": self.joint_units,
            "rotation": self.rotation,
            "tool": self.tool,
            "state_keys": self.state_keys,
            "link": self.link,
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


@dataclass
class EEActionToJoints(ProcessorStep):
    """Poses that a policy answered with to joint commands; the MimicIK weights are this step's state.

    Where a whole chunk passes without a new observation in between (asynchronous inference), each pose starts
    from the command before it.
    """

    policy: dict[str, Any]
    joint_units: str = "rad"
    rotation: str = PoseFormat.QUATERNION.value
    tool: list[float] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    link: str = "ik"
    result: IKResult | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        from lerobot_mimicik.configuration_mimicik import MimicIKConfig
        from lerobot_mimicik.kinematics.chain import SerialArm
        from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
        from lerobot_mimicik.solvers.mimicik import MimicIKSolver

        self._policy = MimicIKPolicy(MimicIKConfig(**self.policy)).eval()
        self._frames = make_frames(self.rotation, self.tool)
        description = self._policy.config.arm_description()
        solver = MimicIKSolver(SerialArm(description), self._policy)
        self._adapter = MimicIKAdapter(solver, description, AdapterSettings(**self.settings))
        self._last: NDArray[np.float64] | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Replaces the action, shape (d,), (B, d) or (B, T, d) with B = 1.

        Raises:
            RuntimeError: no observation has passed `JointsToEEState` before.
            ValueError: several actions at once, or a wrong size.
        """
        action = transition.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            raise ValueError(f"expected an action tensor, got {type(action).__name__}")
        rows = action.reshape(-1, action.shape[-1]).detach().double().cpu().numpy()
        if action.ndim > 1 and action.shape[0] != 1:
            raise ValueError(f"one arm at a time: got a batch of {action.shape[0]}")
        answers = torch.as_tensor(np.stack([self._solve(row) for row in rows]), dtype=action.dtype)
        changed = transition.copy()
        changed[TransitionKey.ACTION] = answers.reshape(*action.shape[:-1], -1).to(action.device)
        return changed

    def _solve(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        measured = JointsToEEState.latest.pop(self.link, self._last)
        if measured is None:
            raise RuntimeError("no joints yet: an observation must pass the preprocessor before an action")
        width = self._frames.form.width
        if len(row) not in (width, width + 1):
            raise ValueError(f"expected a pose of {width} numbers, with or without a gripper, got {len(row)}")
        try:
            target = self._frames.from_policy(row[:width], self._adapter.forward(measured))
        except ValueError:
            target = np.full(7, np.nan)  # no rotation: the adapter holds and says so
        self.result = self._adapter.solve(measured, target)
        self._last = self.result.q
        q = np.degrees(self._last) if self.joint_units == "deg" else self._last
        return np.concatenate([q, row[width:]])

    def get_config(self) -> dict[str, Any]:
        """What the checkpoint stores beside the weights."""
        return {
            "policy": self.policy,
            "joint_units": self.joint_units,
            "rotation": self.rotation,
            "tool": self.tool,
            "settings": self.settings,
            "link": self.link,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """The MimicIK weights."""
        return {name: value.contiguous() for name, value in self._policy.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Loads the weights, strictly, and with them how far targets were from the tool in training.

        Raises:
            CheckpointError: a tensor is missing, surplus, misshapen or not finite; it names it.
        """
        load_tensors(self._policy, state, "the weights of EEActionToJoints")
        settings = AdapterSettings(**self.settings)
        self._adapter = MimicIKAdapter(self._adapter.solver, self._adapter.description, settings)

    def reset(self) -> None:
        """Forget the past."""
        JointsToEEState.latest.pop(self.link, None)
        self._adapter.reset()
        self._last = self.result = None

    def transform_features(self, features: Features) -> Features:
        """Not known to the policy's pipeline."""
        return features


def make_frames(rotation: str, tool: list[float]) -> PolicyFrames:
    """Absolute poses in a rotation format, with a tool frame; an empty one is the arm's own."""
    return PolicyFrames(form=PoseFormat(rotation), tool=tool or tuple(IDENTITY))
