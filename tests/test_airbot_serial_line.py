"""The serial-line interface: whole lines, both ways, and an arm at the other end of the wire."""

import os

import can
import pytest
from arm_process import arm_process, follow_for_a_while
from hypothesis import given, settings
from hypothesis import strategies as st
from serial_line import joined_ports

from robot_adapters.can.bus import open_bus

IDS, PAYLOADS = st.integers(0, 0x7FF), st.binary(max_size=8)


@pytest.fixture(scope="module")
def ports():
    with joined_ports() as paths:
        yield paths


@pytest.fixture(scope="module")
def buses(ports):
    both = [open_bus("slcan", path, sleep_after_open=0.0) for path in ports]
    yield both
    for bus in both:
        bus.shutdown()


def received(bus, count, timeout=60.0):
    return [bus.recv(timeout) for _ in range(count)]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(IDS, PAYLOADS), min_size=1, max_size=20))
def test_frames_arrive_as_they_were_sent_and_in_order(buses, frames):
    for sender, receiver in (buses, buses[::-1]):
        for identifier, data in frames:
            sender.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        found = [(one.arbitration_id, bytes(one.data)) for one in received(receiver, len(frames))]
        assert found == frames


def test_nothing_comes_where_nothing_is_sent(buses):
    assert buses[0].recv(0.0) is None
    assert buses[0].recv(0.01) is None


@pytest.mark.parametrize(
    "line", [b"t00", b"tXYZ8", b"t0018AAt0028BB", b"", b"\xff\xfe", b"z", b"t0019" + b"0" * 18]
)
def test_damaged_lines_are_dropped(buses, ports, line):
    port = os.open(ports[1], os.O_WRONLY | os.O_NOCTTY)
    try:
        os.write(port, line + b"\r")
    finally:
        os.close(port)
    good = can.Message(arbitration_id=0x12, data=[1, 2], is_extended_id=False)
    buses[1].send(good)
    found = received(buses[0], 1)
    assert buses[0].recv(0.05) is None
    assert [(one.arbitration_id, bytes(one.data)) for one in found] == [(0x12, b"\x01\x02")]


def test_an_adapters_acknowledgements_hide_no_frame(buses, ports):
    port = os.open(ports[1], os.O_WRONLY | os.O_NOCTTY)
    try:
        os.write(port, b"\r\rz\r\a" + b"t0122AABB\r" + b"z\rz\r" + b"t0131CC\r")
    finally:
        os.close(port)
    first = buses[0].recv(60.0)
    # Without waiting, as the control loop reads: what has come is read, whatever stands between.
    found = [first, buses[0].recv(0.0)]
    assert [(one.arbitration_id, bytes(one.data)) for one in found] == [(0x12, b"\xaa\xbb"), (0x13, b"\xcc")]


def test_an_arm_at_the_other_end_of_a_serial_line():
    with joined_ports() as (arm, driver), arm_process("slcan", arm):
        statistics = follow_for_a_while("slcan", driver)
    assert statistics.frames_unknown == 0
