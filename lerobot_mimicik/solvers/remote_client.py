"""IKClient: a solver whose answers come from an IK server."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from lerobot_mimicik.solvers.base import Array, IKSolver
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import ServerTimeoutError, ServingError
from lerobot_mimicik.wire.security import ClientKeys, is_local, secure_client


class IKClient(IKSolver):
    """One solver of one server, asked as if it were here; for one thread at a time.

    The server keeps the history of a stateful solver in a session, which `reset` opens, as does the first
    question if there was no `reset`. After a timeout the connection is made anew, and an answer that comes
    late is never taken for the answer to another question; whether the server's solver has seen the frame
    that timed out is unknown, so whoever needs an exact history calls `reset`.

    All errors that concern the server are `ServingError` (a RuntimeError): `ServerTimeoutError` (also a
    TimeoutError), `BadRequestError` (also a ValueError), `UnknownSessionError`, `RateExceededError` and
    `SolverFailedError`.

    Attributes:
        session: The token of the session on the server; empty before there is one.
    """

    def __init__(
        self,
        address: str,
        solver: str,
        joint_names: Sequence[str] | None = None,
        timeout_s: float = 1.0,
        keys: ClientKeys | None = None,
        name: str = "",
    ) -> None:
        """Connect, and ask the server what it has.

        Args:
            address: The server's `tcp://HOST:PORT` or `ipc://PATH`.
            solver: Name of one of its solvers.
            joint_names: Joints that the arm must have, in this order; None: whichever it has.
            timeout_s: Longest wait for an answer, in s.
            keys: Own and the server's key; needed where the server has keys.
            name: How tables call it; empty: the solver's name and that it is remote.

        Raises:
            ValueError: If the address is none, the timeout is not positive, or the server has no such solver
                or another arm.
            ServerTimeoutError: If the server does not answer.
            OSError: If a key file does not exist.
        """
        is_local(address)  # raises where it is no address
        self.address, self.solver = address, solver
        self._timeout_s = _positive(timeout_s)
        self.name = name or f"{solver} (remote)"
        self._keys = keys
        self._max_bytes: int | None = None
        self._number = 0
        self.session = b""
        self._upcoming: Array | None = None
        self._closed = False
        self._socket = self._connect()
        try:
            self._read_info(joint_names)
        except BaseException:
            self.close()
            raise

    def _read_info(self, joint_names: Sequence[str] | None) -> None:
        info = self._ask("info")
        try:
            self.joint_names = tuple(str(joint) for joint in info["joint_names"])
            solvers = dict(info["solvers"])
            max_bytes = int(info["max_bytes"])
            # A server from before they travelled has neither.
            look_ahead = int(info.get("look_ahead", {}).get(self.solver, 0))
            step_range = info.get("step_ranges", {}).get(self.solver)
            bounds = None if step_range is None else np.array(step_range, dtype=float)
            if bounds is not None and (bounds.shape != (2, 6) or not np.isfinite(bounds).all()):
                raise ValueError(f"step range {step_range}")
        except (AttributeError, TypeError, KeyError, ValueError) as error:
            raise ServingError(f"{self.address} answers, but says nothing about its solvers.") from error
        if self.solver not in solvers:
            raise ValueError(f"{self.address} has no solver {self.solver!r}; it has {', '.join(solvers)}.")
        if joint_names is not None and tuple(joint_names) != self.joint_names:
            raise ValueError(
                f"{self.address} solves for joints {', '.join(self.joint_names)}; "
                f"expected {', '.join(joint_names)}."
            )
        self.batched = bool(solvers[self.solver])
        self._max_bytes = max_bytes
        self.look_ahead = look_ahead
        self._step_range = None if bounds is None else (bounds[0], bounds[1])

    @property
    def step_range(self) -> tuple[Array, Array] | None:
        """That of the server's solver."""
        return self._step_range

    @property
    def timeout_s(self) -> float:
        """Longest wait for an answer, in s."""
        return self._timeout_s

    @timeout_s.setter
    def timeout_s(self, seconds: float) -> None:
        self._timeout_s = _positive(seconds)
        self._limit_waiting(self._socket)

    def _limit_waiting(self, socket: zmq.Socket) -> None:
        # Not with every question: to tell a socket takes long beside an answer from the same computer.
        socket.sndtimeo = socket.rcvtimeo = max(1, round(1e3 * self.timeout_s))

    def reset(self, q: Array) -> None:
        """Forget all history on the server; (dof,) or (B, dof). Opens a session if there is none (any more)."""
        self._upcoming = None
        known, self.session = self.session, self._ask("reset", self.solver, _floats(q))
        if known and known != self.session:
            # Perhaps another server than at first: it may have another solver of that name.
            self._read_info(self.joint_names)

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The server's command; (dof,) and (7,), or where `batched` (B, dof) and (B, 7)."""
        upcoming, self._upcoming = self._upcoming, None
        return self._commands("solve", q_curr, target_pose, *([] if upcoming is None else [upcoming]))

    def foresee(self, upcoming: Array) -> None:
        """Targets (T, 7) after the next one, sent with it as far as the server's solver makes use of them."""
        following = np.asarray(upcoming)[: self.look_ahead]
        self._upcoming = following if len(following) else None

    def solve_recorded(self, q_curr: Array, target_pose: Array) -> Array:
        """The server's answers along one recording, in one request."""
        return self._commands("solve_recorded", q_curr, target_pose)

    def select(self, rows: NDArray[np.intp]) -> None:
        """Go on with these rows of the batch."""
        if self.session:
            self._ask("select", protocol.encode_array(np.asarray(rows), protocol.INDEX))

    def close(self) -> None:
        """Give the session back and disconnect; a second call does nothing. Afterwards questions fail."""
        if not self._closed:
            self._closed = True
            if self.session:
                # Nobody waits for the answer: a session that is not given back is dropped some day.
                with suppress(zmq.ZMQError):
                    self._socket.send(protocol.pack_request(0, "close", self.session), zmq.NOBLOCK)
            self._socket.close(linger=100)

    def __enter__(self) -> IKClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _commands(self, method: str, q_curr: Array, *poses: Array) -> Array:
        q = np.asarray(q_curr)
        if not self.session:
            self.reset(q[:1] if method == "solve_recorded" and self.batched else q)
        value = self._ask(method, protocol.encode_array(q), *(_floats(each) for each in poses))
        commands = protocol.decode_array(value, "answer")
        if commands.shape != q.shape:
            raise ServingError(f"{self.address} answered with shape {commands.shape}, expected {q.shape}.")
        return commands

    def _ask(self, method: str, *arguments: Any) -> Any:
        """Send one request and wait for its own answer."""
        if self._closed:
            raise ServingError(f"The client of {self.address} is closed.")
        self._number += 1
        message = protocol.pack_request(self._number, method, self.session, arguments)
        if self._max_bytes is not None and len(message) > self._max_bytes:
            raise ValueError(
                f"The question has {len(message)} bytes, {self.address} takes {self._max_bytes}: "
                "ask about fewer rows at a time."
            )
        deadline = time.monotonic() + self.timeout_s
        try:
            self._socket.send(message)
            number, value = protocol.unpack_reply(self._socket.recv())
            if number != self._number:
                value = self._later_answer(deadline)
        except zmq.Again:
            self._socket.close(0)
            self._socket = self._connect()
            raise ServerTimeoutError(self._timeout_message()) from None
        if isinstance(value, ServingError):
            raise value
        return value

    def _later_answer(self, deadline: float) -> Any:
        """The answer to the last question, after those to ones that a caller's exception (a signal, say) left."""
        try:
            while True:
                self._socket.rcvtimeo = max(0, round(1e3 * (deadline - time.monotonic())))
                number, value = protocol.unpack_reply(self._socket.recv())
                if number == self._number:
                    return value
        finally:
            self._limit_waiting(self._socket)

    def _connect(self) -> zmq.Socket:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        try:
            socket.linger = 0
            self._limit_waiting(socket)
            socket.ipv6 = "[" in self.address
            if self._keys is not None:
                secure_client(socket, self._keys)
            socket.connect(self.address)
        except BaseException:
            socket.close(0)
            raise
        return socket

    def _timeout_message(self) -> str:
        keys = (
            "is this client's public key among those that the server allows, and the server's the right one"
            if self._keys is not None
            else "does the server want keys"
        )
        return (
            f"No answer from {self.address} within {self.timeout_s:g} s. Is `mimicik serve` running there, can "
            f"it be reached, {keys}? If it is only slow, raise timeout_s."
        )


def _positive(timeout_s: float) -> float:
    if not timeout_s > 0:
        raise ValueError(f"timeout_s must be positive, got {timeout_s}.")
    return timeout_s


def _floats(array: Array) -> list[Any]:
    return protocol.encode_array(np.asarray(array))
