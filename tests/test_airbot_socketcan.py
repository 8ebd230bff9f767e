"""SocketCAN: frames through the kernel, and an arm at the other end of the bus.

Needs a CAN device that nothing else uses: `ip link add vcan0 type vcan && ip link set vcan0 up`, or another that
MIMICIK_CAN names.
"""

import os
from pathlib import Path

import can
import pytest
from arm_process import arm_process, follow_for_a_while

from robot_adapters.can.bus import bus_off_report, open_bus, reports_bus_off

DEVICE = os.environ.get("MIMICIK_CAN", "vcan0")

pytestmark = pytest.mark.skipif(
    not Path("/sys/class/net", DEVICE).exists(), reason=f"no CAN device {DEVICE} on this computer"
)


def test_frames_arrive_as_they_were_sent_and_in_order():
    frames = [(number * 37 % 0x800, bytes(range(number % 9))) for number in range(200)]
    with open_bus("socketcan", DEVICE) as sender, open_bus("socketcan", DEVICE) as receiver:
        for identifier, data in frames:
            sender.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        found = [receiver.recv(60.0) for _ in frames]
        assert [(one.arbitration_id, bytes(one.data)) for one in found] == frames
        assert receiver.recv(0.01) is None
        assert sender.recv(0.0) is None


def test_the_controllers_report_of_a_bus_off_is_seen():
    with open_bus("socketcan", DEVICE) as sender, open_bus("socketcan", DEVICE) as receiver:
        sender.send(bus_off_report())
        assert reports_bus_off(receiver.recv(60.0))


def test_an_arm_at_the_other_end_of_the_bus():
    with arm_process("socketcan", DEVICE):
        statistics = follow_for_a_while("socketcan", DEVICE)
    assert statistics.frames_unknown == 0
