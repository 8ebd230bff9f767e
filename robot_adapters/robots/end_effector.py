"""The end-effector face of a robot's arm: poses under LeRobot's flat keys to joints and back.

A robot in end-effector space holds one face for each of its arms; measuring and moving joints stays the robot's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.poses import IDENTITY, PolicyFrames, PoseFormat
from robot_adapters.adapter import IKResult, IKStatus, MimicIKAdapter

Array = NDArray[np.float64]

SPELLINGS = {"pos": "ee.{}.pos", "lerobot": "ee.{}"}
"""How a robot spells the numbers of its poses: as features that every LeRobot command takes, or as LeRobot's steps do."""
_ACCEPTED = ("ee.{}.pos", "ee.{}", "eef.{}", "eef_{}.pos")
"""Spellings that actions may come in; the last two are those of the AIRBOT datasets."""
_GRIPPERS = ("ee.gripper.pos", "ee.gripper_pos", "eef.gripper", "gripper.pos")
DELTA = ("delta_x", "delta_y", "delta_z")
"""What LeRobot's keyboard and gamepad send, along x, y, z of the base frame."""
_LEASH = 0.05  # m that a target led by a keyboard may be ahead of the command: the arm stops with the key
_SHORT, _NONE = 0.5, 0.1
"""Lengths of a quaternion: below the first it was blended of two of opposite signs, below the second it is none."""


class PoseKeys:
    """Keys of one arm's pose and gripper."""

    def __init__(
        self, form: PoseFormat, spelling: str = "pos", gripper: bool = True, prefix: str = ""
    ) -> None:
        """`prefix` stands before each key, such as `left_`. Raises ValueError for a spelling that is none."""
        if spelling not in SPELLINGS:
            raise ValueError(f"keys={spelling!r}: expected one of {', '.join(SPELLINGS)}")
        self.form, self.prefix = form, prefix
        self.pose = [prefix + SPELLINGS[spelling].format(name) for name in form.names]
        name = "ee.gripper_pos" if spelling == "lerobot" else "ee.gripper.pos"
        self.gripper = prefix + name if gripper else None

    @property
    def all(self) -> list[str]:
        """All keys, the gripper's last."""
        return [*self.pose, *([self.gripper] if self.gripper else [])]

    def read(self, action: Mapping[str, Any]) -> tuple[PoseFormat, Array, float | None]:
        """Format and numbers of the pose, and the gripper, in any accepted spelling and format.

        Raises:
            KeyError: A number is missing; the message lists what the action has.
        """
        form, numbers = self._pose(action)
        if self.gripper is None:
            return form, numbers, None
        for key in (self.gripper, *(self.prefix + name for name in _GRIPPERS)):
            if key in action:
                return form, numbers, float(action[key])
        raise KeyError(f"the action has no {self.gripper!r}; it has {sorted(action)}")

    def _pose(self, action: Mapping[str, Any]) -> tuple[PoseFormat, Array]:
        for form, keys in self._candidates():
            if all(key in action for key in keys):
                return form, np.array([float(action[key]) for key in keys])
        missing = [key for key in self.pose if key not in action]
        raise KeyError(f"the action lacks {missing}; it has {sorted(action)}, expected {self.all}")

    def _candidates(self) -> Iterator[tuple[PoseFormat, list[str]]]:
        yield self.form, self.pose
        # The two 6-D formats have the same names: only the robot's own can be told.
        others = [
            each for each in (PoseFormat.QUATERNION, PoseFormat.ROTATION_VECTOR) if each is not self.form
        ]
        for form in (self.form, *others):
            for spelling in _ACCEPTED:
                yield form, [self.prefix + spelling.format(name) for name in form.names]

    def write(self, numbers: Array, gripper: float | None) -> dict[str, float]:
        """The numbers under their keys."""
        named = dict(zip(self.pose, numbers.tolist(), strict=True))
        if self.gripper is not None:
            named[self.gripper] = float("nan") if gripper is None else float(gripper)
        return named


class EndEffectorFace:
    """One arm's poses to joints and back.

    Attributes:
        keys: Names of its numbers.
        result: What became of the last pose; None before.
        delta_step: What a keyboard's or gamepad's 1 moves the target by in a frame [m].
        gripper_range: The gripper's positions when closed and when open, in the robot's unit.
    """

    def __init__(
        self,
        load: Callable[[], MimicIKAdapter],
        keys: PoseKeys,
        tool: Sequence[float] = (),
        warn: Callable[[str, str], None] = lambda name, message: None,
    ) -> None:
        """`load` makes the inverse kinematics at first use; `warn` takes the name of an event and a message."""
        self.keys = keys
        self.tool = tuple(tool) or tuple(IDENTITY)
        self.frames = PolicyFrames(form=keys.form, tool=self.tool)
        self.result: IKResult | None = None
        self.delta_step = 0.002
        self.gripper_range = (0.0, 100.0)
        self._load, self._warn = load, warn
        self._adapter: MimicIKAdapter | None = None
        self._upcoming: list[Mapping[str, Any]] = []
        # What a keyboard leads on: T_base_tool (7,), and the gripper.
        self._led: Array | None = None
        self._grip: float | None = None

    @property
    def adapter(self) -> MimicIKAdapter:
        """The inverse kinematics, loaded at first use."""
        if self._adapter is None:
            self._adapter = self._load()
        return self._adapter

    def reset(self) -> None:
        """Forget the past."""
        self.adapter.reset()
        self.result = self._led = self._grip = None
        self._upcoming = []

    def check(self, action: Mapping[str, Any]) -> None:
        """Raise KeyError unless the action has all that `solve` needs."""
        if not self._led_by(action):
            self.keys.read(action)

    def _led_by(self, action: Mapping[str, Any]) -> bool:
        return all(self.keys.prefix + key in action for key in DELTA)

    def observed(self, q: Array, gripper: float | None) -> dict[str, float]:
        """The pose of measured joints [rad] (dof,), and the gripper."""
        return self.keys.write(self.frames.to_policy(self.adapter.forward(q)), gripper)

    def foresee(self, actions: Sequence[Mapping[str, Any]]) -> None:
        """Say which actions follow the next one, one a frame. Raises KeyError for a missing number."""
        for action in actions:
            self.keys.read(action)
        self._upcoming = list(actions)

    def solve(
        self, action: Mapping[str, Any], measured: Array, gripper: float | None
    ) -> tuple[Array, float | None]:
        """Joints [rad] (dof,) at most one step away, and the gripper, on the way to an action's pose.

        A gripper that the action does not speak of stays as it was commanded, or first measured.

        Args:
            action: A pose in one of the accepted spellings, or a keyboard's `delta_x`, `delta_y`, `delta_z`.
            measured: Joints [rad] (dof,).
            gripper: As measured, in the robot's unit; None without one.

        Raises:
            KeyError: A number is missing.
            ValueError: The measured joints are far outside their limits.
        """
        following, self._upcoming = self._upcoming, []
        now = self.adapter.forward(measured)
        held = gripper if self._grip is None else self._grip
        if self._led_by(action):
            target, gripper = self._lead(action, now, held)
            upcoming = []
        else:
            form, numbers, given = self.keys.read(action)
            gripper = held if given is None else self._opening(given, held)
            target = self._target(form, numbers, now)
            upcoming = [self._target(*self.keys.read(each)[:2], now) for each in following]
        self.result = result = self.adapter.solve(measured, target, upcoming)
        if result.status in (IKStatus.UNREACHABLE, IKStatus.FAILED):
            self._warn(result.status, f"{result.status}: {result.message}")
        self._led = self._leashed(target, self.adapter.forward(result.q))
        self._grip = gripper
        return result.q, gripper

    def sent(self, q: Array, gripper: float | None) -> dict[str, float]:
        """The pose of the joints [rad] (dof,) that were really sent; the next step starts from them."""
        self.adapter.commanded(q)
        return self.observed(q, gripper)

    def _lead(
        self, action: Mapping[str, Any], now: Array, gripper: float | None
    ) -> tuple[Array, float | None]:
        """The target led on by a keyboard; without a key it stays, whatever the arm does (it sags, mostly)."""
        target = (now if self._led is None else self._led).copy()
        target[:3] += self.delta_step * np.array([float(action[self.keys.prefix + key]) for key in DELTA])
        if self.keys.gripper is None or gripper is None:
            return target, gripper
        closed, opened = self.gripper_range
        # 0 closes, 1 stays, 2 opens.
        way = 0.02 * (opened - closed) * (float(action.get(f"{self.keys.prefix}gripper", 1.0)) - 1.0)
        moved = self._opening(gripper + way, gripper)
        return target, float(np.clip(moved, min(closed, opened), max(closed, opened)))

    def _opening[Held: float | None](self, given: float, held: Held) -> float | Held:
        """A gripper's position as given, or as held where that is no number."""
        if math.isfinite(given):
            return given
        self._warn("gripper", f"the gripper's position is {given}: it stays")
        return held

    def _leashed(self, target: Array, reached: Array) -> Array | None:
        if not np.isfinite(target).all():
            return self._led
        led, way = target.copy(), target[:3] - reached[:3]
        far = float(np.linalg.norm(way))
        if far > _LEASH:
            led[:3] = reached[:3] + way * _LEASH / far
        return led

    def _target(self, form: PoseFormat, numbers: Array, now: Array) -> Array:
        frames = self.frames if form is self.frames.form else PolicyFrames(form=form, tool=self.tool)
        if form is PoseFormat.QUATERNION and _NONE < np.linalg.norm(numbers[3:]) < _SHORT:
            # LeRobot blends numbers linearly, also of two quaternions of opposite signs: the rotation stays meanwhile.
            numbers = np.concatenate([numbers[:3], self._in_force(now, frames)[3:]])
        try:
            return frames.from_policy(numbers, now)
        except ValueError as error:
            self._warn("pose", str(error))
            return np.full(7, np.nan)

    def _in_force(self, now: Array, frames: PolicyFrames) -> Array:
        """The pose in force, or the measured one before any, in a policy's frames."""
        return frames.to_policy(now if self.result is None else self.adapter.forward(self.result.q))
