"""The stress sets of an arm as LeRobot datasets, one for each kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lerobot_mimicik import outputs
from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.home import with_home
from lerobot_mimicik.data.stress.case import StressCase
from lerobot_mimicik.data.stress.motion import whole_workspace
from lerobot_mimicik.data.stress.near_singular import near_singular
from lerobot_mimicik.data.stress.out_of_reach import out_of_reach
from lerobot_mimicik.data.stress.outside_limits import outside_limits
from lerobot_mimicik.data.stress.reclutching import reclutching
from lerobot_mimicik.data.stress.splices import spliced_chunks
from lerobot_mimicik.data.stress.tremor import RecordedMotion, recorded_trembling, trembling
from lerobot_mimicik.data.writer import write_dataset
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.names import did_you_mean

Maker = Callable[[ArmArrays, int, float, np.random.Generator], list[StressCase]]
_TREMORS = {f"tremor-{mm:g}mm": mm for mm in (0.0, 0.5, 1.0, 2.0)}
"""Root mean square of the tremor by the set's name [mm]."""


def _workspace(arm: ArmArrays, frames: int, fps: float, rng: np.random.Generator) -> list[StressCase]:
    q = whole_workspace(arm, frames + 1, fps, rng)
    return [StressCase.along(arm, q, "Moves between random configurations")]


# The maker, and the number of the random stream: sets of one stream share their motion.
_KINDS: dict[str, tuple[Maker, int]] = {
    **{name: (partial(trembling, rms_mm=mm), 0) for name, mm in _TREMORS.items()},
    "near-singular": (near_singular, 1),
    "out-of-reach": (out_of_reach, 2),
    "splices": (spliced_chunks, 3),
    "reclutching": (reclutching, 4),
    "outside-limits": (outside_limits, 5),
    "workspace": (_workspace, 6),
}
KINDS: tuple[str, ...] = tuple(_KINDS)
"""Names of the stress sets."""
RECORDED_KINDS: tuple[str, ...] = tuple(_TREMORS)
"""Names of those that recorded motion can be made into."""


@dataclass(frozen=True)
class StressSummary:
    """What `make_stress` wrote: the folder, episodes and frames of each kind, and why others are missing."""

    roots: dict[str, Path]
    counts: dict[str, dict[str, int]]
    skipped: dict[str, str]

    def __str__(self) -> str:
        lines = [
            f"{kind}: {self.counts[kind]['episodes']} episodes, {self.counts[kind]['frames']} frames -> {root}"
            for kind, root in self.roots.items()
        ]
        return "\n".join([*lines, *(f"{kind}: left out, {reason}" for kind, reason in self.skipped.items())])


def stress_cases(
    description: ArmDescription,
    kind: str,
    episodes: int,
    seconds: float,
    fps: int,
    seed: int = 0,
    recorded: Sequence[RecordedMotion] = (),
) -> tuple[ArmArrays, list[StressCase]]:
    """The episodes of one stress set and the arm that they are for; the same seed gives the same.

    With `recorded` motion its first `episodes` take the place of the motion that would be made; a tremor alone can be
    added to it.

    Raises:
        ValueError: If there is no such kind, a number is out of range, or the arm cannot have it.
    """
    if kind not in _KINDS:
        raise ValueError(
            f"unknown stress set {kind!r}; known are {', '.join(KINDS)}.{did_you_mean(kind, KINDS)}"
        )
    frames = round(seconds * fps)
    if episodes < 1 or frames < 2:
        raise ValueError(f"{episodes} episodes of {frames} frames: expected at least 1 of at least 2 frames")
    arm = ArmArrays(with_home(description))
    maker, stream = _KINDS[kind]
    if recorded:
        if kind not in _TREMORS:
            raise ValueError(
                f"{kind} makes its own motion; along recorded motion: {', '.join(_TREMORS)} (--stress.kinds)"
            )
        return arm, [
            recorded_trembling(motion, frames, fps, _stream(seed, stream, i), _TREMORS[kind])
            for i, motion in enumerate(recorded[:episodes])
            if len(motion.state) > 1
        ]
    cases: list[StressCase] = []
    for i in range(episodes):
        cases += maker(arm, frames, fps, _stream(seed, stream, i))
    return arm, cases


def _stream(*numbers: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(numbers))


def make_stress(
    output: str | Path,
    description: ArmDescription,
    *,
    kinds: Sequence[str] = KINDS,
    episodes: int = 4,
    seconds: float = 30.0,
    fps: int = 20,
    seed: int = 0,
    robot_type: str | None = None,
    overwrite: bool = False,
    recorded: Sequence[RecordedMotion] = (),
    inputs: Sequence[str | Path] = (),
) -> StressSummary:
    """Write the stress sets of an arm as `output`/KIND.

    Args:
        output: Folder for the datasets.
        description: The arm; a home posture is found where it has none.
        kinds: Of `KINDS`.
        episodes: For each kind.
        seconds: Length of an episode, s; starts outside the limits are shorter and more.
        fps: Frames per second.
        seed: Of everything random.
        robot_type: LeRobot's free-form robot name.
        overwrite: Replace datasets that are already there.
        recorded: Motion of this arm to add tremor to, in place of motion that is made.
        inputs: Folders that it was read from, which are never written into.

    Raises:
        ValueError: If a kind is not known or a number is out of range.
        FileExistsError: If a dataset is already there.
    """
    unknown = [kind for kind in kinds if kind not in _KINDS]
    if unknown:
        raise ValueError(
            f"unknown stress set {unknown[0]!r}; known are {', '.join(KINDS)}.{did_you_mean(unknown[0], KINDS)}"
        )
    for kind in kinds:
        outputs.check_new(Path(output) / kind, "dataset", overwrite, inputs)
    description = with_home(description)
    roots: dict[str, Path] = {}
    counts: dict[str, dict[str, int]] = {}
    skipped: dict[str, str] = {}
    for kind in kinds:
        try:
            arm, cases = stress_cases(description, kind, episodes, seconds, fps, seed, recorded)
        except ValueError as error:
            if len(kinds) == 1 or episodes < 1:
                raise
            # An arm without limits has no start outside them: the other sets are still worth having.
            skipped[kind] = str(error)
            continue
        roots[kind] = Path(output) / kind
        counts[kind] = write_dataset(
            roots[kind],
            f"local/{kind}",
            [case.episode(arm, f"{kind}-{i}") for i, case in enumerate(cases)],
            description,
            fps=fps,
            robot_type=robot_type,
            overwrite=overwrite,
        )
    if not roots:
        raise ValueError("; ".join(f"{kind}: {reason}" for kind, reason in skipped.items()))
    return StressSummary(roots, counts, skipped)
