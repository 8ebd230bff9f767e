"""What users feel beside accuracy: smoothness, freezing, release, lag, the clean target, self-collision.

- *jerk RMS*: root mean square of the commands' third differences times the cube of the frame rate, rad/s^3.
- *frozen*: percent of all frames in which no commanded joint moved by more than `STILL_RAD` while a target in
  reach moved by more than `MOVED_MM` or `MOVED_DEG`.
- *release step*: largest joint step within `RELEASE_S` of a target's return into reach, rad.
- *return*: most frames until the command is within `BACK_MM` of a target that has returned into reach, has jumped
  (the recorded joints moved by more than a step allows, as where a hand takes hold again), or is a recording's first.
- *late*: most of these frames that a straight way at the largest step that the solver made would have saved.
- *seam jerk*: largest third difference of the commands within `SEAM_FRAMES` of a seam between chunks, where what a
  stress set adds to its clean target jumps, as a multiple of the recorded joints' own; 95th percentile over the seams.
- *lag*: the shift, ms, at which the velocity of the commanded tool matches that of the clean target best, by
  normalised cross-correlation within `LAG_FRAMES` frames, over all recordings; a parabola finds parts of a frame.
- *clean error*: as the position error, against the target without what a stress set added to it.
- *excess*: pose error over all frames out of reach, in percent over the unavoidable one.
- *self-collision depth*: how far spheres of the arm's collision shapes enter each other, mm; the floor does not
  count, nor do pairs that touch in the home posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.evaluation.metrics import JOINT_SPIKE_RAD, Trace, jerk_of, pose_cost
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.collision import ArmCollision
from lerobot_mimicik.solvers.base import Array

STILL_RAD = 1e-6  # rounding
MOVED_MM, MOVED_DEG = 0.1, 0.05  # per frame: more than the noise of a pose in float32
RELEASE_S = 0.5
BACK_MM = 1.0
SEAM_FRAMES = 4
SEAM_MM, EVEN_MM = 1.0, 0.01  # a jump of the offset at a seam, and what it changes by elsewhere: rounding
LAG_FRAMES = 10
RESAMPLES = 1000

MOTION_KEYS = (
    "jerk_rms", "frozen", "release_step", "return_frames", "late_frames", "seam_jerk", "lag_ms", "clean_mean_mm",
    "clean_p95_mm", "clean_max_mm", "unavoidable_mm", "excess_percent",
)  # fmt: skip


def summarise_motion(traces: Sequence[Trace], fps: float) -> dict[str, float | None]:
    """The metrics above but the self-collision depth, by `MOTION_KEYS`; None where one does not apply."""
    clean = [_clean_mm(trace) for trace in traces if trace.rollout.trajectory.clean is not None]
    errors = _finite(np.concatenate(clean)) if clean else np.empty(0)
    unavoidable, excess = _excess(traces)
    return {
        "jerk_rms": _root_mean([_jerk_squares(trace, fps) for trace in traces]),
        "frozen": 100.0 * float(np.concatenate([frozen_frames(trace) for trace in traces]).mean()),
        "release_step": _largest([release_steps(trace, fps) for trace in traces]),
        "return_frames": _largest([return_frames(trace)[0] for trace in traces]),
        "late_frames": _largest([return_frames(trace)[1] for trace in traces]),
        "seam_jerk": seam_jerk(traces),
        "lag_ms": lag_ms(traces, fps),
        "clean_mean_mm": float(errors.mean()) if errors.size else None,
        "clean_p95_mm": float(np.percentile(errors, 95)) if errors.size else None,
        "clean_max_mm": float(errors.max()) if errors.size else None,
        "unavoidable_mm": unavoidable,
        "excess_percent": excess,
    }


def frozen_frames(trace: Trace) -> np.ndarray:
    """Frames (T,) in which no joint moved while a target in reach did; never the first."""
    q, target = trace.rollout.q_cmd, trace.rollout.trajectory.target
    frozen = np.zeros(len(q), dtype=bool)
    if len(q) < 2:
        return frozen
    still = np.abs(np.diff(q, axis=0)).max(axis=1) <= STILL_RAD
    moved_mm = 1e3 * np.linalg.norm(np.diff(target[:, :3], axis=0), axis=1)
    cosine = np.abs((target[1:, 3:] * target[:-1, 3:]).sum(axis=1)).clip(max=1.0)
    moved_deg = np.degrees(2 * np.arccos(cosine))
    frozen[1:] = still & ((moved_mm > MOVED_MM) | (moved_deg > MOVED_DEG))
    inside = trace.in_reach
    frozen[1:] &= inside[1:] & inside[:-1]
    return frozen


def release_steps(trace: Trace, fps: float) -> Array:
    """Largest joint step [rad] after each return of the target into reach, (n,); possibly none."""
    inside = trace.in_reach
    returns = np.flatnonzero(inside[1:] & ~inside[:-1]) + 1
    window = round(RELEASE_S * fps)
    return np.array([trace.max_dq[frame : frame + window].max() for frame in returns])


def return_frames(trace: Trace) -> tuple[Array, Array]:
    """Frames from each start, return into reach and jump of the target until a command meets it to `BACK_MM`, (n,).

    0: the first command does. Where none does before the next of them, or the target leaves again, all frames until then
    count.

    Returns:
        The frames, and how many of them a straight way would have saved at the largest step that was made.
    """
    inside, rollout = trace.in_reach, trace.rollout
    came = inside & ~np.concatenate([[False], inside[:-1]])
    q = rollout.trajectory.q
    came[:-1] |= inside[:-1] & (np.abs(np.diff(q, axis=0)).max(axis=1) > JOINT_SPIKE_RAD)
    left = ~inside & np.concatenate([[False], inside[:-1]])
    edges = [*np.flatnonzero(came | left), len(inside)]
    step = np.nanmax(np.append(trace.max_dq, STILL_RAD))
    frames, late = [], []
    for begin, end in pairwise(edges):
        if inside[begin]:
            met = np.flatnonzero(trace.position_mm[begin:end] <= BACK_MM)
            number = met[0] if met.size else end - begin
            way = np.abs(rollout.q_cmd[begin + number] - rollout.q_curr[begin]).max() if met.size else 0.0
            frames.append(number)
            late.append(max(0.0, number + 1 - max(1.0, np.ceil(way / step - 1e-6))))
    return np.array(frames, dtype=float), np.array(late, dtype=float)


def seam_jerk(traces: Sequence[Trace]) -> float | None:
    """95th percentile over all seams; see above. None where there are no seams."""
    peaks, own = [], []
    for trace in traces:
        motion, commands = trace.rollout.trajectory, trace.rollout.q_cmd
        if motion.clean is None or len(commands) < SEAM_FRAMES:
            continue
        jerk = jerk_of(commands).max(axis=1)  # row k is about frames k to k + 3
        own.append(jerk_of(motion.q).max())
        for seam in seams(motion.target, motion.clean):
            near = jerk[max(0, seam - SEAM_FRAMES - 3) : seam + SEAM_FRAMES + 1]
            if near.size:
                peaks.append(near.max())
    if not peaks or not max(own) > 0:
        return None
    return float(np.percentile(peaks, 95) / max(own))


def seams(target: Array, clean: Array) -> NDArray[np.int64]:
    """Frames (n,) at which a target's offset (T, 7) from the clean one jumps, and rests before and after."""
    jumps = 1e3 * np.linalg.norm(np.diff((target - clean)[:, :3], axis=0), axis=1)
    return np.flatnonzero((jumps[1:-1] > SEAM_MM) & (jumps[:-2] < EVEN_MM) & (jumps[2:] < EVEN_MM)) + 2


def lag_ms(traces: Sequence[Trace], fps: float) -> float | None:
    """How far the commanded tool is behind the clean target [ms]; None where one of them rests or is too short."""
    shifts = np.arange(-LAG_FRAMES, LAG_FRAMES + 1)
    products = np.zeros(len(shifts))
    tools, targets = np.zeros(len(shifts)), np.zeros(len(shifts))
    for trace in traces:
        trajectory = trace.rollout.trajectory
        wanted = trajectory.target if trajectory.clean is None else trajectory.clean
        tool = np.diff(trace.tool[:, :3], axis=0)
        target = np.diff(wanted[:, :3], axis=0)
        known = np.isfinite(tool).all(axis=1)
        tool = np.where(known[:, None], tool, 0.0)
        if len(tool) <= 2 * LAG_FRAMES:
            continue
        middle = slice(LAG_FRAMES, len(tool) - LAG_FRAMES)
        for i, shift in enumerate(shifts):
            late = tool[LAG_FRAMES + shift : len(tool) - LAG_FRAMES + shift]
            products[i] += (late * target[middle]).sum()
            tools[i] += (late**2).sum()
            targets[i] += (target[middle] ** 2).sum()
    if not (tools > 0).all() or not (targets > 0).all():
        return None
    match = products / np.sqrt(tools * targets)
    best = int(match.argmax())
    if match[best] <= 0:
        return None
    found = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        before, at, after = match[best - 1 : best + 2]
        bend = before - 2 * at + after
        found += 0.5 * (before - after) / bend if bend < 0 else 0.0
    return 1e3 * found / fps


def collision_depth_mm(description: ArmDescription, traces: Sequence[Trace]) -> float | None:
    """Deepest self-collision of all commands [mm], 0.0 without one; None for an arm without shapes to check."""
    collision = _collision(description)
    commands = np.concatenate([trace.rollout.q_cmd for trace in traces])
    commands = commands[np.isfinite(commands).all(axis=1)]
    if not collision.pairs or not len(commands):
        return None
    return max(0.0, -1e3 * float(collision.clearance(commands).min()))


def bootstrap(traces: Sequence[Trace], fps: float, seed: int = 0) -> dict[str, list[float]]:
    """95 % intervals of some means, by resampling whole recordings; empty with fewer than two recordings.

    Returns:
        [low, high] for "mean_mm", "jerk_rms" and, where there is a clean target, "clean_mean_mm".
    """
    if len(traces) < 2:
        return {}
    weights = np.random.default_rng(seed).multinomial(
        len(traces), np.full(len(traces), 1 / len(traces)), RESAMPLES
    )
    parts = {
        "mean_mm": [_finite(trace.position_mm) for trace in traces],
        "jerk_rms": [_jerk_squares(trace, fps) for trace in traces],
    }
    if all(trace.rollout.trajectory.clean is not None for trace in traces):
        parts["clean_mean_mm"] = [_finite(_clean_mm(trace)) for trace in traces]
    intervals: dict[str, list[float]] = {}
    for key, values in parts.items():
        sums, counts = np.array([one.sum() for one in values]), np.array([one.size for one in values])
        number = weights @ counts
        if not counts.any():
            continue
        means = (weights @ sums)[number > 0] / number[number > 0]
        means = np.sqrt(means) if key == "jerk_rms" else means
        intervals[key] = [float(value) for value in np.percentile(means, [2.5, 97.5])]
    return intervals


@lru_cache(maxsize=4)
def _collision(description: ArmDescription) -> ArmCollision:
    joints = description.joints()
    middle = [0.5 * (j.lower + j.upper) if np.isfinite(j.lower + j.upper) else 0.0 for j in joints]
    return ArmCollision(description, np.array(description.home or middle), floor=None)


def _clean_mm(trace: Trace) -> Array:
    clean = trace.rollout.trajectory.clean
    if clean is None:
        return np.empty(0)
    return 1e3 * np.linalg.norm(trace.tool[:, :3] - clean[:, :3], axis=1)


def _jerk_squares(trace: Trace, fps: float) -> Array:
    return _finite((jerk_of(trace.rollout.q_cmd).ravel() * fps**3) ** 2)


def _excess(traces: Sequence[Trace]) -> tuple[float | None, float | None]:
    """Mean unavoidable pose error [mm] over frames out of reach, and percent that commands were over it."""
    least, found = [], []
    for trace in traces:
        trajectory = trace.rollout.trajectory
        away = ~trace.in_reach & np.isfinite(trace.tool).all(axis=1)
        if trajectory.closest is not None and away.any():
            least.append(pose_cost(trajectory.closest[away], trajectory.target[away]))
            found.append(pose_cost(trace.tool[away], trajectory.target[away]))
    if not least:
        return None, None
    unavoidable = np.concatenate(least)
    ratio = float(np.concatenate(found).sum() / unavoidable.sum())
    return 1e3 * float(unavoidable.mean()), 100.0 * (ratio - 1.0)


def _root_mean(squares: Sequence[Array]) -> float | None:
    together = np.concatenate(list(squares))
    return float(np.sqrt(together.mean())) if together.size else None


def _largest(values: Sequence[Array]) -> float | None:
    found = _finite(np.concatenate(list(values)))
    return float(found.max()) if found.size else None


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]
