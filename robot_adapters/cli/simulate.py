"""`mimicik simulate`: a simulated AIRBOT Play on a bus that other processes reach, until it is interrupted."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_mimicik.cli.options import parse

HELP = "Put a simulated arm on a bus, for robots and commands in other processes (--interface=udp_multicast)."


@dataclass
class SimulateConfig:
    """Options of `mimicik simulate`."""

    # python-can's interface: udp_multicast reaches other processes; a vcan0 with socketcan does as well.
    interface: str = "udp_multicast"
    # A multicast address, vcan0; null: the interface's usual one.
    channel: str | None = None
    # Whether the arm has a G2 gripper.
    gripper: bool = True
    # Joints [rad] at which it stands; empty: its everyday posture.
    start: list[float] = field(default_factory=list)
    # Of sensor noise and reply times.
    seed: int = 0


def main(argv: Sequence[str]) -> int:
    """Run until interrupted or terminated."""
    # Set even for SIGINT: a shell that starts this in the background leaves it ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    config = parse(SimulateConfig, argv, "mimicik simulate")
    from robot_adapters.airbot.protocol import Tool
    from robot_adapters.simulation.simulated_arm import serve

    print(f"A simulated arm on {config.interface}; Ctrl-C ends it.", flush=True)
    serve(
        config.interface,
        config.channel,
        q=config.start or None,
        tool=Tool.G2 if config.gripper else Tool.NONE,
        seed=config.seed,
    )
    return 0
