"""What travels between IK client and server: one frame, a request id and a msgpack body of fixed form.

    request   id (8 bytes) | [version, method, session, argument, ...]
    reply     id (8 bytes) | [version, True, value]   or   [version, False, code, message]

The id is the client's and comes back unread, also where the body is refused. A session is the token that
`reset` answered with, or empty. An array is `[dtype, shape, bytes]`, row-major and little-endian. A method
with its arguments and value:

    info                              {"joint_names", "solvers": {name: batched}, "max_bytes", "max_rows",
                                       "step_ranges": {name: [lower, upper], six numbers each, or None},
                                       "look_ahead": {name: frames}}
    reset           solver, q         the session: the given one, or a new one where the server has it not
    solve           q, target         commands, shaped as q
    solve           q, target, next   the same, told of the next targets (T, 7), T at most the solver's look_ahead
    solve_recorded  q, target         commands, (T, dof)
    select          rows              None
    close                             None

Nothing here trusts its input: whatever bytes come in, decoding ends in values of the stated types or in
`BadRequestError`. No object is ever built from a name in the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

VERSION = 1
ID_BYTES = 8
FLOAT = "<f8"
INDEX = "<i8"
MAX_TEXT = 64
MAX_TOKEN = 32
_MAX_MESSAGE = 500
_LONGEST_AXIS = 1 << 31


class ServingError(RuntimeError):
    """What went wrong between a client and its server; `code` is its name on the wire."""

    code = "server"


class BadRequestError(ServingError, ValueError):
    """The request is not one that the server answers: its form, a shape, a value, a name."""

    code = "request"


class UnknownSessionError(ServingError, LookupError):
    """The server has no such session (any more); `reset` opens a new one."""

    code = "session"


class RateExceededError(ServingError):
    """The client asked more often than the server allows; the request was not looked at."""

    code = "rate"


class SolverFailedError(ServingError):
    """The solver raised an error on the server; the message is the solver's."""

    code = "solver"


class ServerTimeoutError(ServingError, TimeoutError):
    """No answer came in time. What a stateful solver has seen is then unknown until the next `reset`."""

    code = "timeout"


_ERRORS: dict[str, type[ServingError]] = {
    error.code: error
    for error in (ServingError, BadRequestError, UnknownSessionError, RateExceededError, SolverFailedError)
}


def encode_array(array: NDArray[Any], dtype: str = FLOAT) -> list[Any]:
    """An array of any shape as it travels."""
    return [dtype, list(array.shape), np.ascontiguousarray(array, dtype).tobytes()]


def decode_array(item: Any, name: str, dtype: str = FLOAT) -> NDArray[Any]:
    """A writable array of its own memory, with at most two axes.

    Args:
        item: What msgpack read.
        name: What error messages call it.
        dtype: The only one that is taken.

    Raises:
        BadRequestError: If `item` is no such array; the message names what was found.
    """
    if type(item) is not list or len(item) != 3:
        raise BadRequestError(f"{name}: expected an array [dtype, shape, bytes], got {type(item).__name__}.")
    kind, shape, raw = item
    if kind != dtype:
        raise BadRequestError(f"{name}: expected dtype {dtype!r}, got {_shown(kind)}.")
    if type(shape) is not list or len(shape) > 2:
        raise BadRequestError(f"{name}: expected a shape of at most two axes, got {_shown(shape)}.")
    size = 8
    for length in shape:
        if type(length) is not int or not 0 <= length < _LONGEST_AXIS:
            raise BadRequestError(f"{name}: expected a shape of whole numbers, got {_shown(shape)}.")
        size *= length
    if type(raw) is not bytes or len(raw) != size:
        found = f"{len(raw)} bytes" if type(raw) is bytes else type(raw).__name__
        raise BadRequestError(f"{name}: a {dtype!r} array of shape {shape} has {size} bytes, got {found}.")
    # The copy is aligned and writable, which the bytes of the message are not; solvers may want both.
    return np.frombuffer(raw, dtype).reshape(shape).copy()


def pack_request(number: int, method: str, session: bytes, arguments: Sequence[Any] = ()) -> bytes:
    """A request as one frame; `number` is its id."""
    return number.to_bytes(ID_BYTES) + msgpack.packb([VERSION, method, session, *arguments])


def unpack_request(message: bytes) -> tuple[str, bytes, list[Any]]:
    """Method, session and arguments of a request.

    Raises:
        BadRequestError: If the frame is none; the message says what is wrong with it.
    """
    if len(message) <= ID_BYTES:
        raise BadRequestError(
            f"Expected {ID_BYTES} bytes of request id and a msgpack body, got {len(message)} bytes."
        )
    try:
        body = msgpack.unpackb(
            memoryview(message)[ID_BYTES:],
            max_array_len=8,
            max_str_len=MAX_TEXT,
            max_map_len=0,
            max_ext_len=0,
        )
    # Which errors a hostile message provokes in the decoder is no part of its interface: all mean the same.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise BadRequestError(
            f"The body is no msgpack of the expected form: {reason[:_MAX_MESSAGE]}."
        ) from error
    if type(body) is not list or len(body) < 3:
        raise BadRequestError("Expected [version, method, session, arguments ...].")
    version, method, session, *arguments = body
    if type(version) is not int or version != VERSION:
        raise BadRequestError(f"Expected protocol version {VERSION}, got {_shown(version)}.")
    if type(method) is not str:
        raise BadRequestError(f"Expected a method's name, got {_shown(method)}.")
    if type(session) is not bytes or len(session) > MAX_TOKEN:
        raise BadRequestError(f"Expected a session of at most {MAX_TOKEN} bytes, got {_shown(session)}.")
    return method, session, arguments


def pack_reply(identity: bytes, value: Any) -> bytes:
    """The answer to the request whose id was `identity`."""
    return identity + msgpack.packb([VERSION, True, value])


def pack_error(identity: bytes, error: ServingError) -> bytes:
    """The refusal of the request whose id was `identity`."""
    return identity + msgpack.packb([VERSION, False, error.code, str(error)[:_MAX_MESSAGE]])


def unpack_reply(message: bytes) -> tuple[int, Any]:
    """Id and value of a reply; an error is returned as the exception that it means, not raised.

    Raises:
        ServingError: If the frame is no reply of this protocol.
    """
    try:
        body = msgpack.unpackb(memoryview(message)[ID_BYTES:])
        version, ok, value, *rest = body
    except Exception as error:
        raise ServingError(f"What answers there is no IK server: {type(error).__name__}.") from error
    if version != VERSION or len(message) <= ID_BYTES or (not ok and len(rest) != 1):
        raise ServingError(
            f"What answers there speaks another protocol than version {VERSION}: {body!r:.80}."
        )
    number = int.from_bytes(message[:ID_BYTES])
    return number, value if ok else _ERRORS.get(value, ServingError)(str(rest[0]))


def _shown(value: Any) -> str:
    """A value from a stranger, short enough for an error message."""
    return f"{value!r:.60}" if isinstance(value, str | int | bytes) else type(value).__name__
