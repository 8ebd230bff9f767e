"""A trembling target made steady: moved towards what a learned prior foresees, never further than a promised radius."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.approach import turned, turned_by
from lerobot_mimicik.guidance.model import ArmModel
from lerobot_mimicik.guidance.settings import GuidanceSettings

Array = NDArray[np.float64]

_UNLIKELY = 4.0
"""A proposal that is further from the target than so many radii knows nothing of this motion, and fades."""


class Foresees(Protocol):
    """Proposes joints for a stream of targets, and says how much these tremble."""

    @property
    def tremor(self) -> tuple[float, float]:
        """Root mean square of the targets' trembling [m, rad]."""

    def reset(self, q: Array) -> None:
        """The arm is at rest at `q` (dof,)."""

    def __call__(self, start: Array, target: Array) -> Array:
        """Proposed joints (dof,) for a target (7,) from joints (dof,)."""


def steadied(
    foresight: Foresees, model: ArmModel, settings: GuidanceSettings, start: Array, target: Array
) -> Array:
    """The pose (7,) to go to in the target's place.

    It lies between the target and the pose of the proposed joints. The promised radius and angle shrink with the
    tremor of the last targets: without any, the target itself is the answer.

    Args:
        foresight: Who proposes.
        model: The arm.
        settings: `foresight_radius`, `foresight_angle` and `foresight_gain`.
        start: Joints that the step starts from (dof,).
        target: `T_base_tool` (7,), unit quaternion.
    """
    proposed = foresight(start.copy(), target.copy())
    if not np.isfinite(proposed).all():
        return target
    pose = model.pose(np.clip(proposed, model.lower, model.upper))
    shift = pose[:3] - target[:3]
    turn = turned(target[3:], pose[3:])
    shift *= _share(shift, foresight.tremor[0], settings.foresight_radius, settings.foresight_gain)
    turn *= _share(turn, foresight.tremor[1], settings.foresight_angle, settings.foresight_gain)
    return np.concatenate([target[:3] + shift, turned_by(target[3:], turn)])


def _share(way: Array, tremor: float, most: float, gain: float) -> float:
    """Fraction of the way to the proposal, a length in m or rad, that may be gone."""
    length = float(np.linalg.norm(way))
    radius = min(most, gain * tremor)
    if length <= radius or length == 0:
        return 1.0 if radius > 0 else 0.0
    far = _UNLIKELY * most
    return radius / length * min(1.0, (far / length) ** 2)
