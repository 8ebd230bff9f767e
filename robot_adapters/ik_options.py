"""Options of the inverse kinematics inside robots, commands and checkpoints."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robot_adapters.adapter import AdapterSettings, MimicIKAdapter


@dataclass
class IKOptions:
    """Which checkpoint answers, and how its answers are judged; see `AdapterSettings`."""

    # MimicIK checkpoint: a folder, a training run's output folder, or a Hub repository.
    path: str = ""
    # Where the network runs: cpu, cuda, mps.
    device: str = "cpu"
    # Joints that a step starts from: commanded (the command in force) or measured.
    reference: str = "commanded"
    # Largest joint motion of one command [rad].
    max_step: float = 0.095
    # Error of a target that counts as reached [m].
    position_tolerance: float = 0.002
    # Error of a target that counts as reached [rad].
    rotation_tolerance: float = 0.02

    def load(self) -> MimicIKAdapter:
        """The adapter.

        Raises:
            ValueError: without a path; FileNotFoundError, TypeError: if there is no MimicIK checkpoint.
        """
        from robot_adapters.adapter import MimicIKAdapter

        if not self.path:
            raise ValueError("ik.path is missing: the MimicIK checkpoint that turns poses into joints")
        return MimicIKAdapter.from_pretrained(self.path, self.device, **asdict(self.settings()))

    def settings(self) -> AdapterSettings:
        """The adapter's settings. Raises ValueError for one out of range."""
        from robot_adapters.adapter import AdapterSettings

        return AdapterSettings(
            reference=self.reference,
            max_step=self.max_step,
            position_tolerance=self.position_tolerance,
            rotation_tolerance=self.rotation_tolerance,
        )
