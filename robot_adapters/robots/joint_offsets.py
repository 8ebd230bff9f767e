"""Calibration offsets: what is added to a robot's joints to have the joints of its URDF."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_KEY = "offsets_rad"
MARK = _KEY.encode()
"""What a file of offsets shows that it is one by."""
LARGEST_OFFSET = np.pi
"""rad: half a turn, beyond which an offset is the same as a smaller one or a mistake."""


def offsets_file(robot: Any) -> Path | None:
    """Where the offsets of a LeRobot robot are: beside its calibration."""
    folder = getattr(robot, "calibration_dir", None)
    return None if folder is None else Path(folder) / f"{robot.id}.offsets.json"


def read_offsets(path: Path, joint_names: Sequence[str]) -> Array:
    """Offsets [rad] (dof,) in the order of the joints; zeros where there is no file.

    Raises:
        ValueError: The file is damaged, or of other joints.
    """
    if not path.is_file():
        return np.zeros(len(joint_names))
    try:
        values = json.loads(path.read_text(encoding="utf-8"))[_KEY]
        offsets = np.array([float(values[name]) for name in joint_names])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} holds no offsets of the joints {list(joint_names)} ({error!r}): measure them anew with "
            "mimicik calibrate, or remove the file"
        ) from error
    if not (np.abs(offsets) <= LARGEST_OFFSET).all():
        raise ValueError(f"{path}: offsets of {offsets.tolist()} rad; expected at most half a turn")
    return offsets


def write_offsets(path: Path, joint_names: Sequence[str], offsets: ArrayLike) -> None:
    """Write offsets [rad] (dof,).

    Raises:
        ValueError: An offset of more than half a turn; the message says what may be wrong.
    """
    values = np.asarray(offsets, dtype=float).tolist()
    if not all(abs(value) <= LARGEST_OFFSET for value in values):
        found = dict(zip(joint_names, np.degrees(values).round(1).tolist(), strict=True))
        raise ValueError(
            f"offsets of {found} degrees; expected at most half a turn: are the robot's joints in another unit "
            "(--joint_units), or the postures another arm's?"
        )
    text = json.dumps({_KEY: dict(zip(joint_names, values, strict=True))}, indent=2)
    path.write_text(text + "\n", encoding="utf-8")
