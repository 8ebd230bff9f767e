"""Chunks of targets that do not fit together, blended: a jump between two of them is spread over some frames.

A policy's next chunk rarely begins where the last one was going. The seam is the policy's, not the motion's: behind it
the arm goes on along the new chunk. Where the seam is known ahead, half of the blend comes before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
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
        self._frames, self._lever, self._reach = frames, lever, reach
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
        offsets = np.sum([self._offsets(seam, np.arange(len(targets))) for seam in self._seams], axis=0)
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
        here = len(self._past)
        if len(poses) < 4:
            return {}
        odd, jumps = _uneven(poses, self._lever, _SMALLEST * self._reach, _LARGEST * self._reach)
        # Row i is about the step to pose i + 2.
        return {i + 2 - here: odd[i] for i in np.flatnonzero(jumps).tolist() if i >= here - 2}


@njit(cache=True, error_model="numpy")
def _ways(poses):
    """The ways (T - 1, 6) [m, rad] from each pose of (T, 7) to the next, the short way round."""
    ways = np.empty((len(poses) - 1, 6))
    for t in range(len(ways)):
        a, b = poses[t], poses[t + 1]
        cosine = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6]
        sign = -1.0 if cosine < 0 else 1.0
        square = 0.0
        for k in range(3):
            i, j = 3 + (k + 1) % 3, 3 + (k + 2) % 3
            sine = sign * (a[6] * b[3 + k] - b[6] * a[3 + k] - (b[i] * a[j] - b[j] * a[i]))
            ways[t, k], ways[t, 3 + k] = b[k] - a[k], sine
            square += sine * sine
        size = math.sqrt(square)
        ways[t, 3:] *= 2.0 if size < 1e-9 else 2.0 * math.atan2(size, sign * cosine) / size
    return ways


@njit(cache=True, error_model="numpy")
def _uneven(poses, lever, smallest, largest):
    """Of each step but the first and last, what its neighbours do not explain (T - 3, 6), and whether it is a jump."""
    steps = _ways(poses)
    # Constant acceleration leaves nothing.
    odd = steps[1:-1] - 0.5 * (steps[:-2] + steps[2:])
    count = len(odd)
    sizes, jumps = np.empty(count), np.zeros(count, dtype=np.bool_)
    for i in range(count):
        square = 0.0
        for k in range(3):
            square += odd[i, k] ** 2 + (lever * odd[i, 3 + k]) ** 2
        sizes[i] = math.sqrt(square)
    for i in range(count):
        nearby = 0.0
        if i >= 2:
            nearby = sizes[i - 2]
        if i + 2 < count:
            nearby = max(nearby, sizes[i + 2])
        jumps[i] = smallest + _STANDS_OUT * nearby < sizes[i] < largest
    return odd, jumps


def _displaced(pose: Array, twist: Array) -> Array:
    """A pose (7,) moved and turned by `twist` (6,) in the base frame."""
    return np.concatenate([pose[:3] + twist[:3], turned_by(pose[3:], twist[3:])])
