"""`mimicik doctor`: read-only checks of installation, bus, arm and checkpoint, each failure with its remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_mimicik.cli.options import parse

HELP = "Check installation, bus, arm and checkpoint without moving anything; every failure comes with its remedy."


@dataclass
class PolicyPath:
    """The MimicIK checkpoint."""

    # A checkpoint's folder, a training run's output folder, or a Hub repository; empty: none is checked.
    path: str = ""


@dataclass
class DoctorConfig:
    """Options of `mimicik doctor`.

    Example: `mimicik doctor --interface=socketcan --channel=can0 --policy.path=outputs/demo/train`
    """

    policy: PolicyPath = field(default_factory=PolicyPath)
    # Which arm: airbot_play.
    arm: str = "airbot_play"
    # python-can's interface of the arm: socketcan, slcan, udp_multicast, or virtual (a simulated arm); empty:
    # no bus is opened.
    interface: str = ""
    # can0, /dev/ttyACM0, a multicast address; null: the interface's usual one.
    channel: str | None = None
    # Pose of the tool as the vendor's software reports it for the arm as it stands: [x, y, z, qx, qy, qz, qw].
    reported_pose: list[float] = field(default_factory=list)
    # That tool in the end link: [x, y, z, qx, qy, qz, qw]; AIRBOT's own gripper: [0.1594, 0, 0, 0, 0, 0, 1].
    tool: list[float] = field(default_factory=list)


def main(argv: Sequence[str]) -> int:
    """Run the command; status 1 if a check failed."""
    config = parse(DoctorConfig, argv, "mimicik doctor")
    from robot_adapters.checks import CheckOutcome, Finding
    from robot_adapters.doctor import Doctor, DoctorOptions

    def show(finding: Finding) -> None:
        print(f"{finding.outcome.upper():8}{finding.check}: {finding.detail}", flush=True)
        if finding.remedy:
            print(f"        -> {finding.remedy}", flush=True)

    options = DoctorOptions(
        config.arm, config.interface, config.channel, config.policy.path, config.reported_pose, config.tool
    )
    findings = Doctor(options).run(show)
    failed = sum(finding.outcome is CheckOutcome.FAILED for finding in findings)
    print(f"{len(findings)} checks, {failed} failed." if failed else f"{len(findings)} checks, all well.")
    return 1 if failed else 0
