"""`mimicik simulate` in a process of its own, and a driver that finds it there."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
from pace import judged_by_the_pace

from robot_adapters.airbot.arm import AirbotArm
from robot_adapters.arm import DriverStatistics
from robot_adapters.can.bus import BusError


@contextlib.contextmanager
def arm_process(interface: str, channel: str) -> Iterator[subprocess.Popen]:
    """A simulated arm without a gripper; ended by SIGINT, as a user does, unless something went wrong."""
    command = ["simulate", f"--interface={interface}", f"--channel={channel}", "--gripper=false"]
    server = subprocess.Popen(
        [sys.executable, "-m", "lerobot_mimicik.cli.main", *command], stdout=subprocess.PIPE, text=True
    )
    try:
        assert f"simulated arm on {interface}" in server.stdout.readline()
        yield server
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(timeout=120)
        finally:
            server.kill()


def follow_for_a_while(interface: str, channel: str) -> DriverStatistics:
    """Connect to the arm there, hold it for five frames, and see that every motor was heard and nothing happened."""
    arm = AirbotArm(interface, channel, handle_signals=False)
    for _ in range(300):
        try:
            arm.connect()
            break
        except BusError:
            continue
    with judged_by_the_pace(), arm:
        q = arm.read().q
        for _ in range(5):
            assert arm.command(q).q_sent.shape == (6,)
            arm.clock.sleep(0.05)
        state = arm.read()
        assert np.all(np.isfinite(state.q))
        np.testing.assert_allclose(state.q, q, atol=0.05)
        assert state.gripper is None
        statistics = arm.statistics()
        assert not (events := arm.events()), [str(event) for event in events]
        assert min(statistics.frames_received.values()) > 0, statistics
        return statistics
