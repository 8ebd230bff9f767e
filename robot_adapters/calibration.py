"""Calibration offsets of a robot's joints against its URDF, by least squares over postures held and positions measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.point_chain import point_chain

Array = NDArray[np.float64]

_PRIOR = 1e-4
"""Weight of no offset at all: it decides only what the observations leave open."""
_KNOWN = 0.2
"""Fraction of an offset's prior spread below which the observations count as having determined it."""


@dataclass(frozen=True)
class Observation:
    """Joints that the robot reported, and what is known of the arm at that moment.

    Attributes:
        joints: As reported, in rad, without any offset, (dof,).
        held: The URDF's joints [rad] (dof,) that the arm was held at; None where it was not.
        position: Of the tool in the base frame [m] (3,), measured from outside; None where it was not.
    """

    joints: Array
    held: Array | None = None
    position: Array | None = None


@dataclass(frozen=True)
class OffsetFit:
    """Offsets and what they leave.

    Attributes:
        offsets: To be added to the robot's joints [rad] (dof,).
        determined: Whether the observations say something of each joint (dof,).
        joints_left: Root mean square between held and corrected joints [rad] (dof,); NaN without held postures.
        before, after: Tool positions' mean error without and with the offsets [m]; NaN without measured positions.
    """

    offsets: Array
    determined: NDArray[np.bool_]
    joints_left: Array
    before: float
    after: float


def fit_offsets(description: ArmDescription, observations: Sequence[Observation]) -> OffsetFit:
    """Offsets that bring the robot's joints nearest to what is known.

    Args:
        description: The arm.
        observations: At least one, each with a posture or a position; angles and lengths weigh in units of the reach.

    Raises:
        ValueError: Nothing is known, or the arrays do not fit the arm.
    """
    dof = len(description.joint_names)
    _check(observations, dof)
    chain = point_chain(description)
    reach = max(float(np.linalg.norm(chain.pose(each.joints)[:3])) for each in observations) or 1.0

    def residuals(offsets: Array) -> Array:
        rows = [_PRIOR * offsets]
        for each in observations:
            if each.held is not None:
                rows.append(each.joints + offsets - each.held)
            if each.position is not None:
                rows.append((chain.pose(each.joints + offsets)[:3] - each.position) / reach)
        return np.concatenate(rows)

    found = least_squares(residuals, np.zeros(dof), x_scale="jac")
    spread = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))) * _PRIOR
    held = [each.joints + found.x - each.held for each in observations if each.held is not None]
    left = np.sqrt(np.mean(np.square(held), axis=0)) if held else np.full(dof, np.nan)

    def tool_error(offsets: Array) -> float:
        errors = [
            float(np.linalg.norm(chain.pose(each.joints + offsets)[:3] - each.position))
            for each in observations
            if each.position is not None
        ]
        return float(np.mean(errors)) if errors else float("nan")

    return OffsetFit(found.x, spread < _KNOWN, left, tool_error(np.zeros(dof)), tool_error(found.x))


def read_observations(
    path: str | Path, joint_names: Sequence[str]
) -> list[tuple[dict[str, float], Observation]]:
    """What a JSON file recorded: a list of objects with `joints`, and `held` or `position`.

    Args:
        path: The file. `joints` are the robot's keys and numbers as it reports them; `held` the URDF's joints by name
            [degrees]; `position` x y z of the tool [m].
        joint_names: The URDF's joints.

    Returns:
        The robot's own numbers with each observation, whose `joints` are still empty.

    Raises:
        FileNotFoundError: No such file; ValueError: it is not such a list, and in which entry.
    """
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON file: {error}") from error
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: expected a list of at least one observation, found {str(entries)[:50]}")
    found = []
    for number, entry in enumerate(entries):
        try:
            reported = {str(key): float(value) for key, value in entry["joints"].items()}
            held, position = _known(entry, joint_names)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(
                f"{path}, entry {number}: expected joints and held or position, found {str(entry)[:200]} ({error!r})"
            ) from error
        found.append((reported, Observation(np.empty(0), held, position)))
    return found


def _known(entry: Mapping[str, Any], joint_names: Sequence[str]) -> tuple[Array | None, Array | None]:
    held = position = None
    if "held" in entry:
        held = np.radians([float(entry["held"][name]) for name in joint_names])
    if "position" in entry:
        position = np.array([float(value) for value in entry["position"]])
    return held, position


def _check(observations: Sequence[Observation], dof: int) -> None:
    if not observations:
        raise ValueError("no observations: hold a posture or record positions first")
    for number, each in enumerate(observations):
        known = {"joints": (each.joints, dof), "held": (each.held, dof), "position": (each.position, 3)}
        for name, (values, size) in known.items():
            if values is not None and (values.shape != (size,) or not np.isfinite(values).all()):
                raise ValueError(
                    f"observation {number}: {name} {values.tolist()}: expected {size} finite numbers"
                )
        if each.held is None and each.position is None:
            raise ValueError(f"observation {number} has neither held joints nor a position")
