"""Whether recordings are in the units and conventions they were read in: what else spoils all of them at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_mimicik.data.retargeting.recordings import POSITION_UNITS, Recording
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import why_not_joints, why_not_order

# Extents of a recording between which hands and tools move [m]; a person who walks through a hall stays below.
_SMALLEST, _LARGEST = 1e-3, 20.0
# Recordings that the order of quaternions is judged by.
_JUDGED = 20


def check_recordings(
    recordings: Sequence[Recording], description: ArmDescription, max_speed: float, unit: str, where: str
) -> None:
    """Refuse recordings in other units, or with quaternions in another order, than they were read in.

    Args:
        recordings: Positions in metres, quaternions xyzw.
        description: The arm whose joints they may have.
        max_speed: A faster step is a jump of the tracker [m/s]; most steps of a recording are none.
        unit: Unit in which positions were read, for the message.
        where: The source, for the message.

    Raises:
        ValueError: Names what was found and the option that says otherwise.
    """
    extents = [extent for extent in map(_extent, recordings) if np.isfinite(extent)]
    speeds = [speed for speed in map(_speed, recordings) if np.isfinite(speed)]
    extent = float(np.median(extents)) if extents else 0.1
    speed = float(np.median(speeds)) if speeds else 0.0
    if extent > _LARGEST or speed > max_speed or (unit != "m" and extent < _SMALLEST):
        fitting = [
            name
            for name, metres in POSITION_UNITS.items()
            if 10 * _SMALLEST <= extent * metres / POSITION_UNITS[unit] <= _LARGEST / 10
            and speed * metres / POSITION_UNITS[unit] <= max_speed
        ]
        likely = f"; {' or '.join(fitting)} would be plausible" if fitting else ""
        raise ValueError(
            f"{where}: read in {unit}, the recordings extend over {extent:.4g} m and move at {speed:.4g} m/s "
            f"(medians), no motion of a hand or a tool{likely}. Say what they are: --columns.position_unit "
            f"({', '.join(POSITION_UNITS)}), --columns.time_unit (s, ms, us, ns)"
        )
    for recording in recordings[:_JUDGED]:
        reason = _why_not_order(recording, description)
        if reason is not None:
            raise ValueError(
                f"{where}, {recording.name}: {reason}. Say which order it is: --columns.quaternion_order "
                "(xyzw, wxyz)"
            )


def _extent(recording: Recording) -> float:
    """Largest extent along an axis [m] of the middle rows: up to a fifth may be glitches of a tracker, far away."""
    position = recording.pose[np.isfinite(recording.pose).all(axis=1), :3]
    if len(position) < 2:
        return np.nan
    return float(np.ptp(np.quantile(position, (0.2, 0.8), axis=0), axis=0).max())


def _speed(recording: Recording) -> float:
    """Median speed from row to row [m/s]."""
    rows = np.isfinite(recording.pose).all(axis=1) & np.isfinite(recording.t)
    elapsed = np.diff(recording.t[rows])
    moved = np.linalg.norm(np.diff(recording.pose[rows, :3], axis=0), axis=1)
    later = elapsed > 0
    return float(np.median(moved[later] / elapsed[later])) if later.any() else np.nan


def _why_not_order(recording: Recording, description: ArmDescription) -> str | None:
    if recording.joints is None:
        return None
    for joints in (recording.joints, np.radians(recording.joints)):
        if why_not_joints(description, joints) is None:
            return why_not_order(description, joints, recording.pose)
    return None
