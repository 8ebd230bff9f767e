"""What the adapter answers: a joint command and what became of its target."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.certificate import Certificate

Array = NDArray[np.float64]


class IKStatus(enum.StrEnum):
    """What became of a target.

    REACHED: the command meets it within the tolerances, whoever found the command; a command that meets its
    target has no other status, but for FAILED. What counts is what `orientation` asks for: on an arm that cannot
    serve every direction (five joints), the position; the message names the turn that is missing.
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
        q: Joint command [rad], (dof,), never further than the settings' `max_step` from where it started; the
            caller's own.
        status: What became of the target.
        position_error, rotation_error: Between FK(q) and the target [m, rad]; NaN where the target is no pose
            of this arm.
        step: Largest joint motion of the command [rad].
        source: Who found the command: `guided`, the solver's name where guidance trusted it, `branch` on the way to
            another branch of the inverse kinematics, or `hold`.
        message: In words; when reached, the orientation that the arm cannot serve, or nothing.
        certificate: Why it does not meet the target, and the margins; None where the command holds.
    """

    q: Array
    status: IKStatus
    position_error: float
    rotation_error: float
    step: float
    source: str
    message: str = ""
    certificate: Certificate | None = None
