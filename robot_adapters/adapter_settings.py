"""How the adapter guides, asks and judges."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_mimicik.guidance.settings import GuidanceSettings


@dataclass(frozen=True)
class AdapterSettings(GuidanceSettings):
    """How the adapter guides, asks and judges; weights, bounds and tolerances are those of `GuidanceSettings`.

    Attributes:
        reference: Joints that a step starts from: `commanded`, the command in force, while the arm follows
            it within `resync` [rad]; `measured`, always what was measured, lag and noise included.
        resync: Difference between measured and commanded joints from which the measured ones are used [rad]; an
            arm that lags by 0.2 s is 0.4 rad behind where it moves by the largest step at every frame.
        max_translation, max_rotation: Largest part of the way that the solver is asked for at once [m, rad]. A
            MimicIK policy is besides never asked for more than it saw in training.
    """

    reference: str = "commanded"
    resync: float = 0.5
    max_translation: float = 0.05
    max_rotation: float = 0.3

    def __post_init__(self) -> None:
        if self.reference not in ("commanded", "measured"):
            raise ValueError(f"reference={self.reference!r}: expected 'commanded' or 'measured'")
        super().__post_init__()
        for name in ("resync", "max_translation", "max_rotation"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be finite and positive, got {getattr(self, name)}")
