"""Chunks of targets that do not fit together, blended: a jump between two of them is spread over some frames.

A policy's next chunk rarely begins where the last one was going. The seam is the policy's, not the motion's: behind it
the arm goes on along the new chunk. Where the seam is known ahead, half of the blend comes before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.approach import turned_by

Array = NDArray[np.float64]

_SMALLEST, _LARGEST = 0.002, 0.05
"""Jumps that are blended, as fractions of the reach: smaller ones are followed without harm, larger ones are no seam
but another motion, as when an operator takes hold again."""
_STANDS_OUT = 3.0  # multiple of how uneven the targets' steps are nearby, above which a jump is one
_PAST = 4  # targets that are remembered


@dataclass
class _Seam:
    """A jump by `twist` (6,) [m, rad] at frame `at`, blended from frame `begin` on; frames count from the present one."""

    twist: Array
    at: int
    begin: int


class Blending:
    """Turns the targets that are asked for into those that are gone to."""

    def __init__(self, frames: int, lever: float, reach: float) -> None:
        """
        Args:
            frames: Length of a blend; 0 blends nothing.
            lever: Metres that one radian counts as [m/rad].
            reach: Of the arm [m].
        """
        self._frames, self._reach = frames, reach
        self._scale = np.repeat([1.0, lever], 3)
        self._past: list[Array] = []
        self._seams: list[_Seam] = []

    def reset(self) -> None:
        """A new motion begins."""
        self._past, self._seams = [], []

    def __call__(self, targets: Array) -> Array:
        """What to go to in place of targets (T, 7), the present one first; once a frame."""
        if not self._frames:
            return targets
        for seam in self._seams:
            seam.at, seam.begin = seam.at - 1, seam.begin - 1
        self._seams = [seam for seam in self._seams if seam.begin + self._frames > 0]
        if len(targets) > 1:
            self._look(targets)
        self._past = [*self._past, targets[0]][-_PAST:]
        if not self._seams:
            return targets
        offsets = sum(self._offsets(seam, np.arange(len(targets))) for seam in self._seams)
        return np.array([_displaced(pose, offset) for pose, offset in zip(targets, offsets, strict=True)])

    def _offsets(self, seam: _Seam, frames: NDArray[np.int64]) -> Array:
        """Displacements (T, 6) of targets in these frames (T,)."""
        phase = np.clip((frames + 1 - seam.begin) / self._frames, 0.0, 1.0)
        eased = phase**3 * (10 - 15 * phase + 6 * phase**2)  # minimum jerk
        return (eased - (frames >= seam.at))[:, None] * seam.twist

    def _look(self, targets: Array) -> None:
        """Find the seams that are in view."""
        found = self._jumps(targets)
        for seam in [each for each in self._seams if each.at >= 0]:
            if seam.at in found and seam.begin >= 0:
                seam.twist = found[seam.at]
            elif seam.at not in found and seam.at < len(targets) - 1:
                # Another chunk came in its place: what was already gone of it is brought back.
                gone = self._offsets(seam, np.array([-1]))[0]
                seam.twist, seam.at, seam.begin = -gone, -1, 0
        known = [seam.at for seam in self._seams]
        for at, twist in found.items():
            if at not in known:
                self._seams.append(_Seam(twist, at, max(0, at - self._frames // 2)))

    def _jumps(self, targets: Array) -> dict[int, Array]:
        """Frames at which the targets jump, and by how much (6,): steps that their neighbours do not explain."""
        poses = np.array([*self._past, *targets])
        if len(poses) < 4:
            return {}
        steps = _ways(poses)
        # Entry i is about step i + 1, which leads to pose i + 2; constant acceleration leaves nothing.
        odd = steps[1:-1] - 0.5 * (steps[:-2] + steps[2:])
        sizes = np.linalg.norm(odd * self._scale, axis=1)
        here = len(self._past)
        jumps: dict[int, Array] = {}
        for i in range(max(0, here - 2), len(odd)):
            nearby = max([sizes[k] for k in (i - 2, i + 2) if 0 <= k < len(sizes)], default=0.0)
            if _SMALLEST * self._reach + _STANDS_OUT * nearby < sizes[i] < _LARGEST * self._reach:
                jumps[i + 2 - here] = odd[i]
        return jumps


def _ways(poses: Array) -> Array:
    """The ways (T - 1, 6) [m, rad] from each pose of (T, 7) to the next, the short way round."""
    start, end = poses[:-1, 3:], poses[1:, 3:]
    sine = start[:, 3:] * end[:, :3] - end[:, 3:] * start[:, :3] - np.cross(end[:, :3], start[:, :3])
    cosine = (start * end).sum(axis=1)
    size = np.linalg.norm(sine, axis=1)
    angle = 2 * np.arctan2(size, np.abs(cosine)) * np.where(cosine < 0, -1.0, 1.0)
    turns = sine * (angle / np.maximum(size, 1e-12))[:, None]
    return np.concatenate([np.diff(poses[:, :3], axis=0), turns], axis=1)


def _displaced(pose: Array, twist: Array) -> Array:
    """A pose (7,) moved and turned by `twist` (6,) in the base frame."""
    return np.concatenate([pose[:3] + twist[:3], turned_by(pose[3:], twist[3:])])
