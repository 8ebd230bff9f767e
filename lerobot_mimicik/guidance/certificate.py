"""Why a command meets its target, or why not: the certificate of one answer."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.kinematics_kernels import pose_and_jacobian
from lerobot_mimicik.guidance.model import ArmModel

Array = NDArray[np.float64]

_AT_LIMIT = 1e-6  # rad, m: nearer to a limit than that a joint is at it
_SINGULAR = 0.05
"""Smallest singular value of the Jacobian, in arm lengths per rad, below which a direction counts as singular."""


class Reason(enum.StrEnum):
    """What keeps a command off its target."""

    NONE = "none"
    STEP = "step bound"
    LIMIT = "joint limit"
    COLLISION = "self-collision"
    SINGULAR = "singular direction"
    REACH = "out of reach from here"
    SMOOTHNESS = "smoothness"
    INVALID = "no pose of this arm"
    SOLVER = "solver"


@dataclass(frozen=True)
class Certificate:
    """What became of a target, and by how much.

    Attributes:
        reached: Whether the command meets it within the tolerances.
        reason: Why not.
        joints: Names of the joints at their limits or step bounds that are in the way.
        bodies: The two links that would collide, where they are the reason.
        position_error, rotation_error: Of the command [m, rad].
        beyond: What is left per axis once the task's weights and tolerances are counted [m, rad], (6,).
        closest: Errors of the closest configuration that a descent from here finds [m, rad]; None where it was not
            asked for, because the target is reached.
        limit_margin: Distance of the joint that is closest to one of its limits [rad, m]; negative outside.
        gap: Smallest gap between the arm's own bodies [m]; infinite without shapes.
        singular_value: Smallest singular value of the Jacobian, rotations by the arm's lever [m/rad].
        source: Who found the command.
        free_axis: Where the position came first and the orientation is off: the axis of the tool (3,) about which the arm
            cannot turn it in place; None where there is no such single axis.
    """

    reached: bool
    reason: Reason
    joints: tuple[str, ...]
    bodies: tuple[str, str] | None
    position_error: float
    rotation_error: float
    beyond: tuple[float, ...]
    closest: tuple[float, float] | None
    limit_margin: float
    gap: float
    singular_value: float
    source: str
    free_axis: tuple[float, float, float] | None = None

    def __str__(self) -> str:
        """The reason in words; when reached, the orientation that is not served, or nothing."""
        if self.reached and self.free_axis is not None:
            axis = " ".join(f"{value:.2f}" for value in self.free_axis)
            return (
                f"the position is met; the arm cannot turn its tool about the tool's axis ({axis}), the orientation "
                f"is {self.rotation_error:.2f} rad off"
            )
        if self.reached:
            return ""
        words = {
            Reason.STEP: "a step towards a target that is several steps away",
            Reason.LIMIT: f"{_listed(self.joints)} at a limit",
            Reason.SINGULAR: "the arm is singular in the direction that is left",
            Reason.REACH: "out of reach from here",
            Reason.SMOOTHNESS: "in reach, and met only by a less smooth motion",
        }
        text = words.get(self.reason, str(self.reason))
        if self.bodies is not None:
            # The closest configuration knows nothing of bodies.
            return (
                f"{self.bodies[0]} and {self.bodies[1]} would come closer than allowed: "
                f"{self.position_error * 1e3:.1f} mm, {self.rotation_error:.3f} rad are left"
            )
        if self.closest is not None and self.reason not in (Reason.STEP, Reason.SMOOTHNESS):
            text += f": from here the arm comes no closer than {self.closest[0] * 1e3:.1f} mm, {self.closest[1]:.3f} rad"
        return text


def at_limits(model: ArmModel, q: Array) -> NDArray[np.bool_]:
    """Which joints (dof,) are at a limit or outside."""
    return (q <= model.lower + _AT_LIMIT) | (q >= model.upper - _AT_LIMIT)


def smallest_singular(model: ArmModel, q: Array) -> tuple[float, Array]:
    """Smallest singular value [m/rad] of the Jacobian, rotations by the arm's lever, and its direction (6,)."""
    _, _, jacobian = pose_and_jacobian(q, model.chain)
    scaled = jacobian * np.repeat([1.0, model.lever], 3)[:, None] / model.unit
    left, values, _ = np.linalg.svd(scaled)
    last = min(len(values), 6) - 1
    return float(values[last]), left[:, last]


def is_singular(model: ArmModel, q: Array, left_over: Array) -> bool:
    """Whether a pose error (6,) [m, rad] points along a direction that the arm has hardly any motion in."""
    value, direction = smallest_singular(model, q)
    error = left_over * np.repeat([1.0, model.lever], 3)
    size = float(np.linalg.norm(error))
    return value < _SINGULAR * model.reach and size > 0 and abs(float(direction @ error)) > 0.7 * size


def _listed(names: tuple[str, ...]) -> str:
    return " and ".join(names) if names else "a joint"
