"""What the protocol lets through and what it refuses, and the limits, without a network."""

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from lerobot_mimicik.serving.limits import Limits, RateLimiter
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import BadRequestError, ServingError, UnknownSessionError
from lerobot_mimicik.wire.security import is_local

ARRAYS = arrays(np.float64, array_shapes(min_dims=0, max_dims=2, min_side=0, max_side=5))


@given(ARRAYS)
def test_arrays_come_back_bit_by_bit_and_writable(array):
    wire = msgpack.unpackb(msgpack.packb(protocol.encode_array(array)))
    back = protocol.decode_array(wire, "q")
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()
    assert back.flags.writeable


def test_an_array_arrives_the_same_however_it_lies_in_memory():
    array = np.arange(12.0).reshape(3, 4)
    for view in (array[::2], array.T, array[:, ::-1], array.astype(np.float32), array.astype(">f8")):
        np.testing.assert_array_equal(protocol.decode_array(protocol.encode_array(view), "q"), view)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (None, "got NoneType"),
        (["<f8", [1]], r"expected an array \[dtype, shape, bytes\]"),
        (["<f4", [1], bytes(4)], "'<f4'"),
        (["O", [1], bytes(8)], "'O'"),
        (["<f8", [1, 1, 1], bytes(8)], "two axes"),
        (["<f8", [-1], bytes(8)], "whole numbers"),
        (["<f8", [True], bytes(8)], "whole numbers"),
        (["<f8", [1.0], bytes(8)], "whole numbers"),
        (["<f8", [0, 1 << 62], b""], "whole numbers"),
        (["<f8", [1 << 30, 1 << 30], bytes(8)], f"{8 << 60} bytes, got 8"),
        (["<f8", [1], "12345678"], "got str"),
        (["<f8", 1, bytes(8)], "two axes"),
    ],
)
def test_what_is_no_array_is_refused_with_what_it_is(item, message):
    with pytest.raises(BadRequestError, match=message) as caught:
        protocol.decode_array(item, "target")
    assert "target" in str(caught.value)


@given(st.integers(0, 2**64 - 1), st.text(max_size=10), st.binary(max_size=32), st.lists(ARRAYS, max_size=2))
def test_requests_come_back_as_sent(number, method, session, given_arrays):
    wire = [protocol.encode_array(array) for array in given_arrays]
    message = protocol.pack_request(number, method, session, wire)
    assert protocol.unpack_request(message) == (method, session, wire)
    assert int.from_bytes(message[: protocol.ID_BYTES]) == number


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(st.binary(max_size=200) | VALUES.map(lambda value: bytes(8) + msgpack.packb(value)))
def test_any_bytes_end_in_a_request_or_in_a_refusal(message):
    try:
        method, session, arguments = protocol.unpack_request(message)
    except BadRequestError:
        pass
    else:
        assert (type(method), type(session), type(arguments)) == (str, bytes, list)
    try:
        number, _ = protocol.unpack_reply(message)
    except ServingError:
        pass
    else:
        assert number == int.from_bytes(message[:8])


def test_an_error_comes_back_as_itself():
    reply = protocol.pack_error((7).to_bytes(8), UnknownSessionError("gone"))
    number, error = protocol.unpack_reply(reply)
    assert number == 7
    assert isinstance(error, UnknownSessionError)
    assert str(error) == "gone"
    assert issubclass(protocol.ServerTimeoutError, TimeoutError)
    assert issubclass(BadRequestError, ValueError)


def test_the_rate_holds_for_each_client_by_itself_and_is_refilled():
    limiter = RateLimiter(rate=10.0, burst=5.0)
    assert [limiter.allows("a", 0.0) for _ in range(6)] == [True] * 5 + [False]
    assert limiter.allows("b", 0.0)
    assert not limiter.allows("a", 0.05)
    assert limiter.allows("a", 0.15)
    assert sum(limiter.allows("a", 100.0) for _ in range(20)) == 5


@given(st.lists(st.floats(0, 0.5), max_size=60))
def test_no_more_is_allowed_than_burst_and_rate_give(pauses):
    limiter, now, allowed = RateLimiter(rate=4.0, burst=3.0), 0.0, 0
    for pause in pauses:
        now += pause
        allowed += limiter.allows("a", now)
        assert allowed <= 3.0 + 4.0 * now + 1e-6


def test_the_rate_limiter_forgets_rather_than_grows():
    limiter = RateLimiter(rate=1.0, burst=1.0, max_clients=8)
    for client in range(100):
        assert limiter.allows(str(client), 0.0)
    assert len(limiter._buckets) == 8


def test_no_rate_means_no_limit():
    limiter = RateLimiter(rate=0.0, burst=1.0)
    assert all(limiter.allows("a", 0.0) for _ in range(100))


def test_limits_that_let_nothing_through_are_refused():
    with pytest.raises(ValueError, match="max_rows must be at least 1, got 0"):
        Limits(max_rows=0)
    with pytest.raises(ValueError, match="rate"):
        Limits(rate=float("nan"))


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("tcp://127.0.0.1:5555", True),
        ("tcp://127.3.2.1:*", True),
        ("tcp://[::1]:5555", True),
        ("ipc:///run/ik.sock", True),
        ("tcp://*:5555", False),
        ("tcp://0.0.0.0:5555", False),
        ("tcp://[::]:5555", False),
        ("tcp://[::ffff:0.0.0.0]:5555", False),
        ("tcp://eth0:5555", False),
        ("tcp://localhost.example.org:5555", False),
        ("tcp://10.0.0.1:5555", False),
    ],
)
def test_what_can_be_reached_from_outside_is_told_from_what_cannot(address, local):
    assert is_local(address) == local


@pytest.mark.parametrize("address", ["udp://127.0.0.1:5", "tcp://127.0.0.1", "ipc://", "127.0.0.1:5555", ""])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ValueError, match="tcp://HOST:PORT"):
        is_local(address)
