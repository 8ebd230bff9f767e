"""Whether a solver survives singularities: passages in the recording, and a verdict on each rollout.

A *singular passage* is a run of frames where the recorded arm's Jacobian, its linear rows divided by the
arm's characteristic length so that all rows are per radian, has a smallest singular value below
`SINGULAR_VALUE`; passages less than `MERGE_S` apart are one. The verdicts are

- *Diverged*: a command was not finite; or the error left 10 mm, never came back until the end of the
  trajectory at least `RETURN_S` later, and grew: over the second half of that time its mean is over
  `LOST_MM`, or more than `GROWTH` times that over the first half;
- *Singular*: a step over 0.5 rad (E-stop); or a frozen arm: within `FROZEN_S` no commanded joint moved
  by `FROZEN_RAD` while the error stayed over 10 mm and the target went on by more than
  `TARGET_MOVED_MM` or `TARGET_MOVED_DEG`; or an error that did not return under 10 mm within
  `RETURN_S` after a singular passage: the arm is caught;
- *Bounded*: none of these.

An E-stop or a frozen arm comes before a growing error: what follows from them is their consequence. The
verdict on a dataset is the worst of its trajectories. It is about what a solver does to itself, so it is
given where commands feed back, not in open loop. Frames whose target the arm cannot have, where the dataset says so,
are not held against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_mimicik.evaluation.metrics import ESTOP_RAD, Trace
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import rotation_angle
from lerobot_mimicik.solvers.base import Array

SINGULAR_VALUE = 0.05
MERGE_S = 0.25
RETURNED_MM = 10.0
RETURN_S = 2.0
GROWTH = 1.5
LOST_MM = 50.0
FROZEN_S = 1.0
FROZEN_RAD = 2e-3
TARGET_MOVED_MM = 5.0
TARGET_MOVED_DEG = 2.0
_LENGTH_SAMPLES = 256

VERDICTS = ("Bounded", "Singular", "Diverged")
FAILURES = ("non-finite", "E-stop", "frozen", "caught", "lost")


@dataclass(frozen=True)
class Verdict:
    """One of `VERDICTS`, in words what decided it, and which of `FAILURES` that is ("" if none)."""

    verdict: str
    reason: str
    failure: str = ""


@dataclass(frozen=True)
class Passage:
    """Frames `start` to `stop` (exclusive) near a singularity; `deepest` has the smallest value."""

    start: int
    stop: int
    deepest: int
    singular_value: float


def characteristic_length(arm: SerialArm) -> float:
    """Typical distance of the tool from a joint axis, in m: scales linear Jacobian rows to be per radian.

    It is the root mean square of the columns' linear parts over configurations drawn uniformly within the
    limits (a full turn for a joint without any), with a fixed seed: a property of the arm alone.
    """
    generator = np.random.default_rng(0)
    lower = np.nan_to_num(arm.lower.double().numpy(), neginf=-np.pi)
    upper = np.nan_to_num(arm.upper.double().numpy(), posinf=np.pi)
    q = generator.uniform(lower, upper, size=(_LENGTH_SAMPLES, arm.dof))
    linear = arm.jacobian(torch.from_numpy(q))[:, :3].numpy()
    return float(np.sqrt((linear**2).sum(axis=1).mean()))


def smallest_singular_value(arm: SerialArm, q: Array, length: float | None = None) -> Array:
    """Distance to singularity of configurations (T, dof) in rad: (T,), without unit."""
    jacobian = arm.jacobian(torch.from_numpy(q)).numpy().copy()
    jacobian[:, :3] /= characteristic_length(arm) if length is None else length
    return np.linalg.svd(jacobian, compute_uv=False)[:, -1]


def find_passages(singular_value: Array, fps: float) -> list[Passage]:
    """Singular passages of one trajectory from its smallest singular values, (T,)."""
    passages: list[tuple[int, int]] = []
    for start, stop in _runs(singular_value < SINGULAR_VALUE):
        if passages and start - passages[-1][1] < MERGE_S * fps:
            passages[-1] = (passages[-1][0], stop)
        else:
            passages.append((start, stop))
    found = []
    for start, stop in passages:
        deepest = start + int(np.argmin(singular_value[start:stop]))
        found.append(Passage(start, stop, deepest, float(singular_value[deepest])))
    return found


def judge(trace: Trace, passages: Sequence[Passage], fps: float) -> Verdict:
    """The verdict on one rollout, given the singular passages of its recording."""
    if np.isposinf(trace.max_dq).any():
        return Verdict(
            "Diverged", f"non-finite command at {_at(trace, trace.rollout.asked - 1)}", "non-finite"
        )
    if (trace.max_dq > ESTOP_RAD).any():
        frame = int(np.argmax(trace.max_dq > ESTOP_RAD))
        return Verdict("Singular", f"step of {trace.max_dq[frame]:.2f} rad at {_at(trace, frame)}", "E-stop")
    frozen = _first_frozen(trace, fps)
    if frozen is not None:
        return Verdict("Singular", f"frozen arm at {_at(trace, frozen)}", "frozen")
    lost = _lost_for_good(_judged_mm(trace), fps)
    if lost is not None:
        return Verdict("Diverged", f"error grows without return from {_at(trace, lost)}", "lost")
    for passage in passages:
        if returned_after(trace, passage, fps) is False:
            return Verdict(
                "Singular",
                f"not back under 10 mm within {RETURN_S:g} s of {_at(trace, passage.stop)}",
                "caught",
            )
    return Verdict("Bounded", f"{len(passages)} singular passages")


def returned_after(trace: Trace, passage: Passage, fps: float) -> bool | None:
    """Whether the error came back in time after a passage; None where the trajectory ends with it."""
    after = _judged_mm(trace)[passage.stop : passage.stop + round(RETURN_S * fps) + 1]
    return bool((after <= RETURNED_MM).any()) if after.size else None


def judge_all(
    traces: Sequence[Trace], passages: Sequence[Sequence[Passage]], fps: float
) -> tuple[Verdict, list[Verdict]]:
    """The worst verdict over all trajectories, and each one's; `passages` are those of each trajectory."""
    verdicts = [judge(trace, found, fps) for trace, found in zip(traces, passages, strict=True)]
    worst = max(verdicts, key=lambda verdict: VERDICTS.index(verdict.verdict))
    if worst.verdict == "Bounded":
        worst = Verdict("Bounded", f"{sum(map(len, passages))} singular passages")
    return worst, verdicts


def _judged_mm(trace: Trace) -> Array:
    """Position error (T,), zero where the target is out of reach: no solver can be blamed there."""
    return np.where(trace.in_reach, trace.position_mm, 0.0)


def _first_frozen(trace: Trace, fps: float) -> int | None:
    """First frame from which the arm is frozen for `FROZEN_S`, or None."""
    window = round(FROZEN_S * fps)
    frames = len(trace.position_mm)
    if frames <= window:
        return None
    commands = np.lib.stride_tricks.sliding_window_view(trace.rollout.q_cmd, window + 1, axis=0)
    still = (commands.max(axis=-1) - commands.min(axis=-1)).max(axis=-1) < FROZEN_RAD
    far = np.lib.stride_tricks.sliding_window_view(_judged_mm(trace), window + 1).min(axis=-1) > RETURNED_MM
    target = torch.from_numpy(trace.rollout.trajectory.target)
    moved_mm = 1e3 * torch.linalg.vector_norm(target[window:, :3] - target[:-window, :3], dim=-1).numpy()
    moved_deg = np.degrees(rotation_angle(target[window:, 3:], target[:-window, 3:]).numpy())
    frozen = still & far & ((moved_mm > TARGET_MOVED_MM) | (moved_deg > TARGET_MOVED_DEG))
    return int(np.argmax(frozen)) if frozen.any() else None


def _lost_for_good(position_mm: Array, fps: float) -> int | None:
    """First frame of an error that grows until the end without coming back, or None."""
    near = np.flatnonzero(position_mm <= RETURNED_MM)
    start = int(near[-1]) + 1 if near.size else 0
    away = position_mm[start:]
    if len(away) < RETURN_S * fps:
        return None
    half = len(away) // 2
    return start if away[half:].mean() > min(LOST_MM, GROWTH * away[:half].mean()) else None


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(start, stop) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _at(trace: Trace, frame: int) -> str:
    return f"frame {frame} of episode {trace.rollout.trajectory.index}"
