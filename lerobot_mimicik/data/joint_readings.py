"""Readings of an arm's joints as logs have them: what is refused, and what is mended and said.

A log in another unit or of another arm is refused. Single faults, which every long log has, are left out, cut at or
clipped, and counted, so that a summary can say what was done.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import (
    COMMANDS_OUTSIDE_LIMITS,
    FAR_OUTSIDE_LIMITS,
    joint_limits,
    why_not_joints,
)

# So many readings far outside the limits are glitches of an encoder, more are a mistake about the log.
_FEW = 0.01
# No arm's joint is faster [rad/s, m/s], judged over half a frame or more: stamps jitter. 0.5 rad per frame at 20 fps.
_FASTEST = 10.0


@dataclass
class Mended:
    """What was done to readings.

    Attributes:
        not_finite: Rows left out because a number is missing or not finite.
        glitches: Rows left out because a joint is far outside its limits.
        bridged: Longest time without a usable row that frames were interpolated over [s].
        jumps: Places where the recording was cut because a joint jumped.
        short: Time in pieces too short to be used [s].
        clipped: By joint, the number of readings outside its limits and how far out the furthest was [rad, m].
    """

    not_finite: int = 0
    glitches: int = 0
    bridged: float = 0.0
    jumps: int = 0
    short: float = 0.0
    clipped: dict[str, tuple[int, float]] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """The same in words, nothing where nothing was done."""
        said = [
            (self.not_finite, f"{self.not_finite} rows without a finite number for every joint: left out"),
            (self.glitches, f"{self.glitches} rows with a joint far outside its limits: left out"),
            (self.bridged, f"the longest hole that was filled by interpolation: {self.bridged:.2f} s"),
            (self.jumps, f"{self.jumps} jumps of a joint: the recording was cut there"),
            (self.short, f"{self.short:.1f} s in pieces too short to be used: left out"),
        ]
        clipped = [
            f"{name}: {count} readings outside its limits, by {furthest:.3f} rad or m at most: clipped"
            for name, (count, furthest) in self.clipped.items()
        ]
        return [text for amount, text in said if amount] + clipped


def usable_rows(
    description: ArmDescription, measured: np.ndarray, commanded: np.ndarray, where: str, mended: Mended
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which rows can be used, shape (N,), and the joints (N, dof) within their limits, measured and commanded.

    Args:
        description: The arm.
        measured, commanded: Joints [rad, m], (N, dof).
        where: How messages call the log.
        mended: Is told what was done.

    Raises:
        ValueError: The numbers cannot be the arm's joints; names the reason and the options that say otherwise.
    """
    finite = np.isfinite(measured).all(axis=1) & np.isfinite(commanded).all(axis=1)
    mended.not_finite += int(np.count_nonzero(~finite))
    lower, upper = joint_limits(description)
    near = finite.copy()
    for values, margin, what in (
        (measured, FAR_OUTSIDE_LIMITS, "measured"),
        (commanded, COMMANDS_OUTSIDE_LIMITS, "commanded"),
    ):
        with np.errstate(invalid="ignore"):
            inside = ((values >= lower - margin) & (values <= upper + margin)).all(axis=1)
        if np.count_nonzero(finite & ~inside) > _FEW * np.count_nonzero(finite):
            reason = why_not_joints(description, values[finite], margin)
            raise ValueError(
                f"{where}: {what} {reason}. Say what they are: --columns.joint_units (rad, deg), --columns.joints and "
                "--columns.commands (which columns, in the arm's order), --robot (which arm)"
            )
        near &= inside
    mended.glitches += int(np.count_nonzero(finite & ~near))
    clipped = [np.clip(values, lower, upper) for values in (measured, commanded)]
    outside = np.maximum(np.abs(clipped[0] - measured), np.abs(clipped[1] - commanded))[near]
    for name, beyond in zip(description.joint_names, outside.T, strict=True):
        # Encoders and URDFs round their limits.
        if (count := int(np.count_nonzero(beyond > 1e-3))) > 0:
            before, furthest = mended.clipped.get(name, (0, 0.0))
            mended.clipped[name] = (before + count, max(furthest, float(beyond.max())))
    return near, clipped[0], clipped[1]


def pieces(
    time: np.ndarray, joints: np.ndarray, usable: np.ndarray, max_gap: float, fps: int, mended: Mended
) -> Iterator[np.ndarray]:
    """The rows of what is uninterrupted: usable, stamps strictly rising, neither a long hole nor a jump.

    Args:
        time: Stamps [s], (N,).
        joints: (N, k), of which every column counts.
        usable: Which rows are, (N,).
        max_gap: Longer holes cut [s].
        fps: Frames per second of the result.
        mended: Is told what was done.
    """
    rows = np.flatnonzero(np.isfinite(time) & usable)
    if not len(rows):
        return
    latest = np.maximum.accumulate(time[rows])
    rows = rows[np.concatenate([[True], time[rows][1:] > latest[:-1]])]
    elapsed = np.diff(time[rows])
    hole = elapsed > max_gap
    span = np.maximum(elapsed, 0.5 / fps)
    jump = (np.abs(np.diff(joints[rows], axis=0)).max(axis=1) > _FASTEST * span) & ~hole
    mended.jumps += int(np.count_nonzero(jump))
    # Holes of a frame or less are the log's own rate.
    filled = elapsed[(np.diff(rows) > 1) & ~hole & ~jump & (elapsed > 1 / fps)]
    mended.bridged = max([mended.bridged, *filled.tolist()])
    yield from np.split(rows, np.flatnonzero(hole | jump) + 1)
