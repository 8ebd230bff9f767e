"""A joint-space policy made of an end-effector policy and the adapter: what `MimicIKAdapter.wrap` returns.

observation ──> end-effector policy ──> poses T_base_target, one or a chunk of them (+ gripper)
                                             │ one a step, and those after it as `upcoming`
measured joints ───────────────────────> MimicIKAdapter ──> joint command (+ gripper)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.poses import PolicyFrames, PoseFormat
from robot_adapters.arrays import float_array

if TYPE_CHECKING:
    from robot_adapters.adapter import IKResult, MimicIKAdapter

Array = NDArray[np.float64]
STATE, POSE = "observation.state", "observation.ee_pose"


class EndEffectorPolicy:
    """Asks an end-effector policy when its last chunk is used up, and solves for one pose a step.

    Attributes:
        result: What became of the last target; None before the first.
    """

    def __init__(
        self,
        adapter: MimicIKAdapter,
        policy: Any,
        frames: PolicyFrames,
        *,
        actions_per_chunk: int | None = None,
        sees_joints: bool = False,
        preprocessor: Callable[[Any], Any] | None = None,
        postprocessor: Callable[[Any], Any] | None = None,
    ) -> None:
        """
        Args:
            adapter: The arm's inverse kinematics.
            policy: One of
                - a LeRobot policy (`select_action`, or `predict_action_chunk` where there is no other or
                  `actions_per_chunk` is given): the observation becomes a batch of one;
                - a client (`infer`), as remote VLA servers have: a mapping with `actions`, or an array;
                - a function of the observation.
                Each answers with (d,), or a chunk (T, d), or a batch of one chunk (1, T, d), in numpy or torch;
                d is the pose's width, and one more with a gripper.
            frames: Format, reference, tool and base frame of the policy's poses.
            actions_per_chunk: Poses used of a chunk before the policy is asked again; None: all. The arm looks ahead
                at those that are not used, too. LeRobot's `select_action` hides its chunk, so that nothing is known
                of the future: with a number the policy is asked for chunks.
            sees_joints: Whether the policy's `observation.state` is the joints as measured; else it is the
                end-effector pose in `frames.form`, and the gripper where there is one.
            preprocessor, postprocessor: A LeRobot policy's own.

        Raises:
            TypeError: If `policy` is none of these.
            ValueError: `actions_per_chunk` is not positive.
        """
        if actions_per_chunk is not None and actions_per_chunk < 1:
            raise ValueError(f"actions_per_chunk={actions_per_chunk}: expected 1 or more, or None for all")
        self.adapter, self.policy, self.frames = adapter, policy, frames
        self.actions_per_chunk, self.sees_joints = actions_per_chunk, sees_joints
        self.preprocessor, self.postprocessor = preprocessor, postprocessor
        self._ask = self._find_call(policy)
        self._targets: Array = np.empty((0, 7))  # of the chunk in use, from the next one on
        self._openings: list[float | None] = []  # of those that are used before the policy is asked again
        self.result: IKResult | None = None

    def reset(self) -> None:
        """Forget the past, the chunk in use included: call it when an episode starts."""
        self._openings.clear()
        self.adapter.reset()
        self.result = None
        for part in (self.policy, self.preprocessor, self.postprocessor):
            reset = getattr(part, "reset", None)
            if reset is not None:
                reset()

    def select_action(self, observation: Mapping[str, Any]) -> Array:
        """The next joint command.

        Args:
            observation: `observation.state`, the measured joints [rad] (dof,), and the gripper's opening where
                there is one, (dof + 1,); whatever else the policy needs. With a batch of one, (1, dof), all of
                the observation is one, and the policy sees it as such.

        Returns:
            Absolute joint command [rad], (dof,); with the gripper's, (dof + 1,), if the policy commands it or
            the state has it (then it keeps its opening).

        Raises:
            KeyError: Without a state.
            ValueError: A state or an answer of a wrong shape, or an answer that is no pose.
        """
        joints, gripper = self._split(observation)
        if not self._openings:
            self._targets, self._openings = self._chunk(observation, joints, gripper)
        target, self._targets = self._targets[0], self._targets[1:]
        opening = self._openings.pop(0)
        self.result = self.adapter.solve(joints, target, upcoming=self._targets)
        opening = gripper if opening is None else opening
        return self.result.q if opening is None else np.append(self.result.q, opening)

    def _split(self, observation: Mapping[str, Any]) -> tuple[Array, float | None]:
        if STATE not in observation:
            raise KeyError(f"the observation has no {STATE!r}; it has {sorted(observation)}")
        given = float_array(observation[STATE])
        dof = len(self.adapter.joint_names)
        state = given[0] if given.ndim == 2 and len(given) == 1 else given
        if state.shape not in ((dof,), (dof + 1,)):
            raise ValueError(
                f"{STATE}: expected {dof} joints, or these and a gripper, of one arm, got shape {given.shape}"
            )
        return state[:dof], float(state[dof]) if len(state) > dof else None

    def _chunk(
        self, observation: Mapping[str, Any], joints: Array, gripper: float | None
    ) -> tuple[Array, list[float | None]]:
        """The policy's answer as poses `T_base_target` (T, 7), and openings of those that are used."""
        pose = self.adapter.forward(joints)
        seen = dict(observation)
        as_given = np.shape(observation[STATE])[:-1]  # (), or (1,) for a batch of one
        numbers = self.frames.to_policy(pose)
        seen[POSE] = numbers.reshape(*as_given, -1)
        if not self.sees_joints:
            state = numbers if gripper is None else np.append(numbers, gripper)
            seen[STATE] = state.reshape(*as_given, -1)
        answer = self._ask(seen)
        shape = answer.shape
        if answer.ndim == 3 and len(answer) == 1:
            answer = answer[0]
        width = self.frames.form.width
        if answer.ndim not in (1, 2) or answer.shape[-1] not in (width, width + 1) or not answer.size:
            names = " ".join(self.frames.form.names)
            raise ValueError(
                f"the policy answered with shape {shape}; expected poses of {width} numbers ({names}), or "
                f"{width + 1} with a gripper: one (d,), a chunk (T, d) or a batch of one chunk (1, T, d). Other "
                f"formats: PolicyFrames(form=...) with {', '.join(PoseFormat)}"
            )
        rows = np.atleast_2d(answer)
        used = rows[: self.actions_per_chunk]
        if not np.isfinite(used).all():
            # The adapter holds at a target that is not finite, and says so.
            return np.full((1, 7), np.nan), [None]
        # A chunk's relative poses all refer to the pose at which the policy was asked.
        try:
            targets = self.frames.from_policy(rows[:, :width], pose)
        except ValueError:  # perhaps in what is not used: padding, say
            targets = self.frames.from_policy(used[:, :width], pose)
        openings = used[:, width].tolist() if rows.shape[1] > width else [None] * len(used)
        return targets, openings

    def _find_call(self, policy: Any) -> Callable[[dict[str, Any]], Array]:
        methods = ("select_action", "predict_action_chunk")
        for method in methods if self.actions_per_chunk is None else reversed(methods):
            if callable(getattr(policy, method, None)):
                call = getattr(policy, method)
                return lambda observation: self._ask_lerobot(call, observation)
        if hasattr(policy, "infer"):
            return lambda observation: _actions(policy.infer(observation))
        if callable(policy):
            return lambda observation: _actions(policy(observation))
        raise TypeError(
            f"{type(policy).__name__} is no end-effector policy: expected an object with select_action, "
            "predict_action_chunk or infer, or a function of the observation"
        )

    def _ask_lerobot(self, method: Callable[[Any], Any], observation: dict[str, Any]) -> Array:
        """A LeRobot policy's next action (d,), of the chunk that it keeps, or a chunk (T, d)."""
        import torch

        single = np.ndim(observation[POSE]) == 1
        batch: Any = dict(observation)
        for name, value in observation.items():
            if isinstance(value, (np.ndarray, list, tuple)):
                tensor = torch.as_tensor(np.asarray(value), dtype=torch.float32)
                batch[name] = tensor.unsqueeze(0) if single else tensor
        with torch.inference_mode():
            batch = self.preprocessor(batch) if self.preprocessor else batch
            action = method(batch)
            action = self.postprocessor(action) if self.postprocessor else action
        return _actions(action)[0]


def _actions(answer: Any) -> Array:
    if isinstance(answer, Mapping):
        for name in ("actions", "action"):
            if name in answer:
                return _actions(answer[name])
        raise ValueError(f"the policy answered with {sorted(answer)}; expected 'actions'")
    try:
        return float_array(answer)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the policy answered with {type(answer).__name__}, not with numbers: {error}"
        ) from error
