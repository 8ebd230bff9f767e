"""What retargeting did to a set of recordings, in figures and in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.retargeting.retarget import DROPPED, Outcome, RetargetOptions
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.trajectory_ik import forward


@dataclass
class RetargetSummary:
    """What a run did.

    Attributes:
        roots: Folders of the datasets written, by split ("all", or "train" and "test").
        report: The contents of meta/retarget_report.json.
    """

    roots: dict[str, Path] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        report = self.report
        lines = [
            f"{report['recordings']} recordings: {report['kept']} kept as they are, {report['changed']} "
            f"changed, {report['dropped']} dropped",
            *(f"  dropped, {reason}: {count}" for reason, count in report["dropped_for"].items()),
            *(
                f"  {cause}: {entry['episodes']} episodes (median {entry['median']:g})"
                for cause, entry in report["changes"].items()
            ),
            f"{report['frames']} frames in {report['seconds']:.1f} s, "
            f"{report['frames_per_second']:.0f} frames/s",
            f"joints against poses: 99.9 % of frames within {report['fk']['p999_mm']:.3f} mm and "
            f"{report['fk']['p999_deg']:.3f} deg, largest {report['fk']['max_mm']:.3f} mm and "
            f"{report['fk']['max_deg']:.3f} deg",
            *(f"{split}: {root}" for split, root in self.roots.items()),
        ]
        return "\n".join(lines)


def retarget_report(
    source: str | Path, outcomes: Sequence[Outcome], description: ArmDescription, options: RetargetOptions
) -> dict[str, Any]:
    """Figures of a run, JSON-able: how many recordings fared how and why, and how well joints fit poses.

    Args:
        source: Where the recordings came from; only its name is kept.
        outcomes: Of all recordings, at least one of them usable.
        description: The arm.
        options: How the recordings were made to fit.
    """
    status = Counter(outcome.status for outcome in outcomes)
    usable = [outcome for outcome in outcomes if outcome.status != DROPPED]
    amounts: dict[str, list[float]] = {}
    for outcome in usable:
        for cause, amount in outcome.changes.items():
            amounts.setdefault(cause, []).append(amount)
    q = np.concatenate([outcome.q[1:] for outcome in usable])
    target = np.concatenate([outcome.target[1:] for outcome in usable])
    steps = np.concatenate([np.abs(np.diff(outcome.q, axis=0)).max(axis=1) for outcome in usable])
    return {
        "source": Path(source).name,
        "recordings": len(outcomes),
        "kept": status["kept"],
        "changed": status["changed"],
        "dropped": status["dropped"],
        "dropped_for": dict(Counter(o.reason for o in outcomes if o.status == DROPPED).most_common()),
        "changes": {
            cause: {"episodes": len(values), "median": round(float(np.median(values)), 4)}
            for cause, values in sorted(amounts.items(), key=lambda item: -len(item[1]))
        },
        "fk": fk_match(description, q, target),
        "max_step_rad": round(float(steps.max()), 5),
        "workspace_m": np.round(np.ptp(target[:, :3], axis=0), 4).tolist(),
        "seed": options.seed,
        "episodes": [
            {"name": o.name, "status": o.status, "reason": o.reason, "changes": o.changes} for o in outcomes
        ],
    }


def fk_match(description: ArmDescription, q: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """How far FK of joints (N, dof) is from poses (N, 7), both as written in float32 [mm], [deg]."""
    q, target = q.astype(np.float32).astype(np.float64), target.astype(np.float32).astype(np.float64)
    pose = forward(description, q)
    position = 1e3 * np.linalg.norm(pose[:, :3] - target[:, :3], axis=1)
    rotation = np.rad2deg(
        (Rotation.from_quat(pose[:, 3:]) * Rotation.from_quat(target[:, 3:]).inv()).magnitude()
    )
    return {
        "mean_mm": round(float(position.mean()), 5),
        "p999_mm": round(float(np.quantile(position, 0.999)), 5),
        "max_mm": round(float(position.max()), 5),
        "mean_deg": round(float(rotation.mean()), 5),
        "p999_deg": round(float(np.quantile(rotation, 0.999)), 5),
        "max_deg": round(float(rotation.max()), 5),
    }
