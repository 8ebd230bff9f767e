"""Cleaning a raw recording: bad rows, repeated stamps, jumps and gaps go, and it is resampled evenly.

Human and tracker recordings carry rows that are not finite, stamps that repeat, single samples metres away,
and holes. What can be mended is mended and counted; what cannot raises `UnusableRecording` with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lerobot_mimicik.data.retargeting.recordings import Recording


class UnusableRecording(ValueError):  # noqa: N818 - a statement about data, not a failure of the program
    """A recording that cannot be used. `reason` is a short class of causes, the message adds the numbers."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason


@dataclass(frozen=True)
class CleaningOptions:
    """What counts as bad, and how the rest is resampled.

    Attributes:
        fps: Frames per second of the result.
        max_speed: A faster step is a jump of the tracker [m/s].
        max_turn_rate: Likewise [rad/s].
        max_gap: A longer hole in the stamps cuts the recording [s].
        max_bad_share: With more bad rows than this the recording is not worth mending.
        min_duration: Shortest result [s].
        bandwidth: Standard deviation of the smoothing kernel [s]; about one frame takes out jitter and sensor
            noise and leaves the motion.
    """

    fps: int = 20
    max_speed: float = 5.0
    max_turn_rate: float = 25.0
    max_gap: float = 0.3
    max_bad_share: float = 0.2
    min_duration: float = 0.4
    bandwidth: float = 0.05

    def __post_init__(self) -> None:
        for name in ("fps", "max_speed", "max_turn_rate", "max_gap", "min_duration", "bandwidth"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass
class CleanTrajectory:
    """An evenly sampled, smooth motion.

    Attributes:
        pose: x y z qx qy qz qw, unit quaternions of continuous sign, shape (T, 7).
        gripper: Shape (T,) or None.
        repairs: What was done to the recording, cause -> number of rows.
    """

    pose: np.ndarray
    gripper: np.ndarray | None
    repairs: dict[str, int] = field(default_factory=dict)


def clean_recording(recording: Recording, options: CleaningOptions | None = None) -> CleanTrajectory:
    """The recording without its faults, on an even clock of `options.fps`.

    Raises:
        UnusableRecording: Too short, too many bad rows, or stamps that run backwards.
    """
    options = options or CleaningOptions()
    if len(recording) == 0:
        raise UnusableRecording("empty", "no rows")
    t, pose, gripper, repairs = _without_bad_rows(recording, options)
    keep = _longest_run(t, pose, options)
    if (cut := len(t) - int(np.count_nonzero(keep))) > 0:
        repairs["rows cut at jumps or gaps"] = cut
    t, pose = t[keep], pose[keep]
    duration = float(t[-1] - t[0]) if len(t) else 0.0
    if len(t) < 4 or duration < options.min_duration:
        raise UnusableRecording(
            "too short", f"{duration:.2f} s in {len(t)} usable rows, at least {options.min_duration} s wanted"
        )
    grid = t[0] + np.arange(int(np.floor(duration * options.fps + 1e-6)) + 1) / options.fps
    pose[:, 3:] = continuous_signs(pose[:, 3:])
    smooth = local_quadratic(t, pose, grid, options.bandwidth)
    smooth[:, 3:] /= np.linalg.norm(smooth[:, 3:], axis=1, keepdims=True)
    return CleanTrajectory(
        smooth, None if gripper is None else np.interp(grid, t, gripper[keep]), repairs=repairs
    )


def continuous_signs(quaternions: np.ndarray) -> np.ndarray:
    """The same rotations (T, 4) with each quaternion on the side of the one before."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=1))
    signs = np.concatenate([[1.0], np.cumprod(np.where(flips < 0, -1.0, 1.0))])
    return quaternions * signs[:, None]


def local_quadratic(t: np.ndarray, values: np.ndarray, grid: np.ndarray, bandwidth: float) -> np.ndarray:
    """Smooth unevenly sampled values onto a grid by local quadratic regression with a Gaussian kernel.

    Savitzky-Golay's filter for uneven stamps: unlike a moving average it leaves the height of peaks alone.

    Args:
        t: Increasing stamps, shape (n,), n >= 4.
        values: Shape (n, k).
        grid: Where to evaluate, shape (m,).
        bandwidth: Kernel standard deviation, widened where samples are too far apart to support a parabola.

    Returns:
        Shape (m, k).
    """
    step = float(np.median(np.diff(t)))
    window = int(np.clip(2 * np.ceil(3 * bandwidth / step) + 1, min(7, len(t)), min(len(t), 401)))
    centre = np.searchsorted(t, grid)
    first = np.clip(centre - window // 2, 0, len(t) - window)
    index = first[:, None] + np.arange(window)
    offset = t[index] - grid[:, None]
    nearest = np.sort(np.abs(offset), axis=1)[:, 3]
    width = np.maximum(bandwidth, nearest / 1.5)[:, None]
    u = offset / width
    weight = np.exp(-0.5 * u**2)
    basis = np.stack([np.ones_like(u), u, u**2], axis=-1)
    weighted = basis * weight[..., None]
    # The ridge only matters where fewer than three samples carry weight.
    normal = weighted.transpose(0, 2, 1) @ basis + np.diag([0.0, 1e-6, 1e-6])
    right = weighted.transpose(0, 2, 1) @ values[index]
    return np.linalg.solve(normal, right)[:, 0]


def _without_bad_rows(
    recording: Recording, options: CleaningOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, dict[str, int]]:
    t = np.asarray(recording.t, dtype=np.float64)
    pose = np.asarray(recording.pose, dtype=np.float64)
    gripper = recording.gripper
    norm = np.linalg.norm(pose[:, 3:], axis=1)
    finite = np.isfinite(t) & np.isfinite(pose).all(axis=1)
    if gripper is not None:
        finite &= np.isfinite(gripper)
    unit = np.abs(norm - 1) < 0.1
    keep = finite & unit
    # A stamp not later than all before it: repeated, or running backwards.
    latest = np.maximum.accumulate(np.where(keep, t, -np.inf))
    later = np.concatenate([[True], t[1:] > latest[:-1] + 1e-4])
    backwards = np.concatenate([[False], t[1:] < latest[:-1] - 1e-4])
    repairs = {
        "rows not finite": int(np.count_nonzero(~finite)),
        "rows without a unit quaternion": int(np.count_nonzero(finite & ~unit)),
        "rows with a repeated stamp": int(np.count_nonzero(keep & ~later & ~backwards)),
        "rows whose stamp runs backwards": int(np.count_nonzero(keep & backwards)),
    }
    repairs = {cause: count for cause, count in repairs.items() if count}
    for cause, count in repairs.items():
        if count > options.max_bad_share * len(t):
            raise UnusableRecording(f"too many {cause}", f"{count} of {len(t)}")
    keep &= later
    pose = pose[keep]
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return t[keep], pose, None if gripper is None else np.asarray(gripper, dtype=np.float64)[keep], repairs


def _longest_run(t: np.ndarray, pose: np.ndarray, options: CleaningOptions) -> np.ndarray:
    """Mask of the longest run between jumps and gaps, grown by neighbours that connect to it plausibly.

    A glitch is a short run between two jumps: it stays out, and the runs on both sides of it join.
    """
    if len(t) < 2:
        return np.ones(len(t), dtype=bool)
    rows = np.arange(len(t))
    cut = ~_connects(t, pose, rows[:-1], rows[1:], options)
    if not cut.any():
        return np.ones(len(t), dtype=bool)
    runs = np.split(np.arange(len(t)), np.flatnonzero(cut) + 1)
    longest = int(np.argmax([len(run) for run in runs]))
    keep = np.zeros(len(t), dtype=bool)
    keep[runs[longest]] = True
    end = runs[longest][-1]
    for run in runs[longest + 1 :]:
        if _connects(t, pose, end, run[0], options):
            keep[run] = True
            end = run[-1]
    start = runs[longest][0]
    for run in reversed(runs[:longest]):
        if _connects(t, pose, run[-1], start, options):
            keep[run] = True
            start = run[0]
    return keep


def _connects(
    t: np.ndarray,
    pose: np.ndarray,
    before: np.ndarray | int,
    after: np.ndarray | int,
    options: CleaningOptions,
) -> np.ndarray:
    """Whether a body could have moved from one row to the other, for rows or arrays of rows."""
    elapsed = t[after] - t[before]
    # Stamps jitter by several milliseconds; a step is judged over at least half a frame.
    span = np.maximum(elapsed, 0.5 / options.fps)
    moved = np.sqrt(((pose[after, :3] - pose[before, :3]) ** 2).sum(axis=-1))
    cosine = np.abs((pose[after, 3:] * pose[before, 3:]).sum(axis=-1))
    turned = 2 * np.arccos(np.minimum(1.0, cosine))
    return (
        (elapsed <= options.max_gap)
        & (moved <= options.max_speed * span)
        & (turned <= options.max_turn_rate * span)
    )
