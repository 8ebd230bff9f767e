"""`mimicik simulate`: a simulated arm on a bus that other processes reach, until it is interrupted."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_mimicik.cli.options import parse

HELP = "Put a simulated arm on a bus, for robots and commands in other processes (--interface=udp_multicast)."


@dataclass
class SimulateConfig:
    """Options of `mimicik simulate`.

    Example: `mimicik simulate --interface=udp_multicast`
    """

    # Which arm: airbot_play, or openarm_left, openarm_right for LeRobot's own openarm_follower (can_interface=udp_multicast,
    # use_can_fd=false, port=239.74.163.2).
    arm: str = "airbot_play"
    # python-can's interface: udp_multicast reaches other processes; a vcan0 with socketcan does as well.
    interface: str = "udp_multicast"
    # A multicast address, vcan0; null: the interface's usual one.
    channel: str | None = None
    # Whether the AIRBOT Play has a G2 gripper.
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
    if config.arm in ("openarm_left", "openarm_right"):
        from robot_adapters.simulation import openarm

        print(f"A simulated {config.arm} on {config.interface}; Ctrl-C ends it.", flush=True)
        start = {"q": config.start} if config.start else {}
        openarm.serve(
            config.interface, config.channel, side=config.arm.partition("_")[2], seed=config.seed, **start
        )
        return 0
    if config.arm != "airbot_play":
        raise SystemExit(
            f"mimicik simulate: error: --arm={config.arm}: expected airbot_play, openarm_left or openarm_right; any "
            "other arm is simulated by --robot.type=mimicik_sim"
        )
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
