"""What guidance weighs, and how much: costs, bounds and tolerances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.names import did_you_mean

Array = NDArray[np.float64]

_AXES = ("x", "y", "z", "-x", "-y", "-z")
ORIENTATIONS = ("auto", "full", "ranged", "axis", "position")
"""How the orientation of a target counts; see `GuidanceSettings`."""
# What a damaged checkpoint may ask for at most: arms need a few iterations, policies answer with 100 frames or so.
_MOST = {"iterations": 100, "horizon": 1000, "blend": 1000}


def named_axis(axis: str | tuple[float, ...]) -> tuple[float, ...]:
    """A tool axis as a unit vector (3,): x, y, z, -x, -y, -z, or three numbers."""
    if isinstance(axis, str):
        sign = -1.0 if axis.startswith("-") else 1.0
        return tuple(sign * float(axis[-1] == letter) for letter in "xyz")
    return _axis("tool_axis", axis)


def _check_axis_name(name: str) -> None:
    if name not in _AXES:
        raise ValueError(f"tool_axis={name!r}: expected {', '.join(_AXES)}, or three numbers")


def _axis(name: str, values: Sequence[float]) -> tuple[float, ...]:
    """A unit vector (3,), or zeros as they are."""
    numbers = _numbers(name, values)
    if len(numbers) != 3:
        raise ValueError(f"{name}: expected 3 numbers, found {len(numbers)}")
    length = float(np.linalg.norm(numbers))
    return tuple(value / length for value in numbers) if length > 1e-9 else (0.0, 0.0, 0.0)


def _numbers(name: str, values: Sequence[float]) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        numbers = (np.nan,)
    if not all(np.isfinite(numbers)):
        raise ValueError(f"{name}={values!r}: expected finite numbers")
    return numbers


@dataclass(frozen=True)
class PoseTask:
    """Which part of a target pose counts, axis by axis.

    Attributes:
        weight: Of translation x y z and rotation x y z, 6 numbers; 0 leaves an axis free.
        tolerance: How far each axis may be off at no cost [m, rad], 6 numbers.
        frame: `base`, or `tool` for axes of the target's own frame.
        axis: An axis of the tool (3 numbers) that must point right while the tool may turn about it; zeros: none, every
            turn counts.
    """

    weight: tuple[float, ...] = (1.0,) * 6
    tolerance: tuple[float, ...] = (0.0,) * 6
    frame: str = "base"
    axis: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", _axis("axis", self.axis))
        for name in ("weight", "tolerance"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 6 or not all(np.isfinite(values)) or min(values) < 0:
                raise ValueError(f"{name}: expected 6 finite numbers that are not negative, found {values}")
            object.__setattr__(self, name, values)
        if self.frame not in ("base", "tool"):
            raise ValueError(f"frame={self.frame!r}: expected 'base' or 'tool'")
        if not any(self.weight):
            raise ValueError("weight: all axes are free; at least one must count")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> PoseTask:
        """As `GuidanceSettings.of`."""
        _check_names(cls, values)
        return cls(**values)


@dataclass(frozen=True)
class GuidanceSettings:
    """Weights, bounds and tolerances of `Guidance`.

    Weights are relative to the pose error, squared, in units of the arm's reach; joints count in rad. The defaults
    were chosen on generated teleoperation of one arm and hold for others, as `docs/results.md` shows.

    Attributes:
        max_step: Largest joint motion from frame to frame [rad; m where a joint slides].
        position_tolerance, rotation_tolerance: Errors of a target that counts as reached [m, rad].
        velocity, acceleration: Weights of the first and second difference of the joints, one frame at a time.
        exactness: Weight of the second pass, which starts from the first's answer, is pulled to it with this weight, and
            has no other (iterated Tikhonov regularisation): small is exact, large keeps the first pass's smoothness.
        clearance, clearance_width, clearance_fraction: Weight of keeping off the limits, and how far off: so many rad, at
            most that fraction of the joint's range.
        ahead_velocity, ahead_jerk: Weights of the first and third difference where the next targets are known.
        ahead_exactness: Weight of its second pass.
        smoothness: Multiplies `ahead_jerk`.
        horizon: Most frames that are planned at once.
        blend: Frames over which a jump between two chunks of targets is spread where the next ones are known; 0: none.
        posture: Weight of the pull to a posture, for arms with joints to spare; 0 on arms of up to six.
        prior: Weight of a trusted prior.
        foresight_radius, foresight_angle: How far a target may be moved towards what a learned prior foresees [m, rad].
        foresight_gain: How far at most, as a multiple of the root mean square of the targets' own trembling.
        collision: Weight of keeping the arm's bodies apart.
        collision_margin: Gap between bodies that no command lowers, where one exists that does not [m].
        collision_zone: Gap below which bodies push each other apart [m].
        branch_distance: Largest joint motion of a change to another branch of the inverse kinematics [rad]; 0: none.
        branch_detour: How much further from the target than by staying the tool may come meanwhile [m].
        iterations: Most descent steps per pass.
        task: Which part of a target counts.
        orientation: How the orientation counts: `full`, with its weight beside the position's; `ranged`, the position is
            met exactly and the orientation as far as it goes; `axis`, only the direction of `tool_axis` counts; `position`,
            not at all; `auto`, `full` where the arm serves every direction, else `ranged`.
        tool_axis: Axis of the tool that points right with `axis`: x, y, z, -x, -y, -z, or three numbers.
        posture_joints: The posture (dof,) [rad, m] that spare joints are pulled to; empty: the arm's home.
    """

    max_step: float = 0.095
    position_tolerance: float = 0.002
    rotation_tolerance: float = 0.02
    velocity: float = 7e-4
    acceleration: float = 7e-4
    exactness: float = 9e-4
    clearance: float = 3.5e-5
    clearance_width: float = 0.8
    clearance_fraction: float = 0.25
    ahead_velocity: float = 1.7e-3
    ahead_jerk: float = 9e-3
    ahead_exactness: float = 5e-4
    smoothness: float = 1.0
    horizon: int = 8
    blend: int = 8
    posture: float = 1e-5
    prior: float = 1e-3
    foresight_radius: float = 0.0012
    foresight_angle: float = 0.011
    foresight_gain: float = 2.0
    collision: float = 1e-3
    collision_margin: float = 0.005
    collision_zone: float = 0.02
    branch_distance: float = 3.6
    branch_detour: float = 0.02
    iterations: int = 6
    task: PoseTask = PoseTask()
    orientation: str = "auto"
    tool_axis: str | tuple[float, ...] = "z"
    posture_joints: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.task, Mapping):  # read from JSON
            object.__setattr__(self, "task", PoseTask.of(self.task))
        if self.orientation not in ORIENTATIONS:
            raise ValueError(
                f"orientation={self.orientation!r}: expected {' or '.join(ORIENTATIONS)}."
                + did_you_mean(str(self.orientation), ORIENTATIONS)
            )
        if isinstance(self.tool_axis, str):
            _check_axis_name(self.tool_axis)
        else:
            object.__setattr__(self, "tool_axis", _axis("tool_axis", self.tool_axis))
            if not any(self.tool_axis):
                raise ValueError("tool_axis: three zeros are no direction")
        object.__setattr__(self, "posture_joints", _numbers("posture_joints", self.posture_joints))
        positive = (
            "max_step",
            "position_tolerance",
            "rotation_tolerance",
            "iterations",
            "horizon",
            "collision_zone",
        )
        for each in fields(self):
            value: Any = getattr(self, each.name)
            if each.type in ("str", "PoseTask") or "tuple" in str(each.type):
                continue
            number: Any = Integral if each.type == "int" else Real
            if isinstance(value, bool) or not isinstance(value, number):
                kind = "a whole number" if each.type == "int" else "a number"
                raise ValueError(f"{each.name}={value!r}: expected {kind}")
            if not np.isfinite(value) or value < 0 or (each.name in positive and not value > 0):
                wanted = "positive" if each.name in positive else "not negative"
                raise ValueError(f"{each.name} must be finite and {wanted}, got {value}")
            if value > _MOST.get(each.name, np.inf):
                raise ValueError(f"{each.name}={value}: expected at most {_MOST[each.name]}")
        if self.collision_margin > self.collision_zone:
            raise ValueError(
                f"collision_margin={self.collision_margin} is above collision_zone={self.collision_zone}"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Settings from keyword arguments or JSON.

        Raises:
            ValueError: One does not exist, or its value does not fit; the message names it.
        """
        _check_names(cls, values)
        return cls(**values)

    def but(self, **changes: Any) -> GuidanceSettings:
        """These settings with some changed."""
        return replace(self, **changes)


def _check_names(settings: Any, values: Mapping[str, Any]) -> None:
    known = [each.name for each in fields(settings)]
    for name in values:
        if name not in known:
            raise ValueError(
                f"there is no setting {name!r}.{did_you_mean(str(name), known)} Known are {', '.join(known)}"
            )
